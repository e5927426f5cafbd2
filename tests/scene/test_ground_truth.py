"""The conventions against images somebody else rendered: synface64's exact depth, normals and light."""

import csv
import io
import math
import zipfile
from dataclasses import dataclass

import numpy as np
import pytest
import torch
from PIL import Image
from torch import Tensor
from torch.nn.functional import max_pool2d

from derender.scene.camera import rotation_matrix
from derender.scene.light import lambert_shading, light_direction
from derender.scene.normals import normals_from_depth

COUNT = 64


@dataclass(frozen=True)
class Truth:
    """Some of synface64's test_gt, as its README describes it; maps in 0..1, angles in radians."""

    image: Tensor
    depth: Tensor
    normal: Tensor
    albedo: Tensor
    inside: Tensor
    light: Tensor
    rotation: Tensor
    light_direction: Tensor
    light_direction_cam: Tensor


@pytest.fixture
def truth(shared_data) -> Truth:
    with zipfile.ZipFile(shared_data("data/synface64.zip")) as archive:
        rows = list(csv.DictReader(io.StringIO(archive.read("test_gt/params.csv").decode())))[:: 800 // COUNT]

        def maps(folder: str, ending: str = "png") -> Tensor:
            names = (f"test_gt/{folder}/{row['file'].split('/')[1].split('.')[0]}.{ending}" for row in rows)
            stack = np.stack([np.asarray(Image.open(io.BytesIO(archive.read(name)))) for name in names])
            return torch.from_numpy(stack.astype(np.float32))

        image, depth, normal = maps("images", "jpg"), maps("depth"), maps("normal")
        albedo, mask = maps("albedo"), maps("mask")

    def columns(*names: str) -> Tensor:
        return torch.tensor([[float(row[name]) for name in names] for row in rows])

    outside = max_pool2d((mask == 0).float()[:, None], 3, 1, 1)[:, 0]  # eroded by one pixel
    inside = outside == 0
    inside[:, [0, -1]] = False
    inside[:, :, [0, -1]] = False
    angles = columns("light_pitch", "light_yaw").deg2rad()
    return Truth(
        image=image / 255,
        depth=0.8 + depth / 65535 * 0.4,
        normal=torch.nn.functional.normalize(normal / 255 * 2 - 1, dim=-1),
        albedo=albedo / 255,
        inside=inside,
        light=torch.cat((columns("ambient", "diffuse"), angles), dim=1),
        rotation=rotation_matrix(columns("pitch", "yaw", "roll").deg2rad()),
        light_direction=columns("lx", "ly", "lz"),
        light_direction_cam=columns("lx_cam", "ly_cam", "lz_cam"),
    )


def test_light_directions_are_those_stored(truth):
    assert (light_direction(truth.light) - truth.light_direction).abs().max() < 2e-6  # stored with 6 digits
    turned = (truth.rotation @ light_direction(truth.light)[..., None])[..., 0]
    assert (turned - truth.light_direction_cam).abs().max() < 2e-6


def test_albedo_times_shading_is_the_image(truth):
    canonical_normal = torch.einsum("nij,nhwi->nhwj", truth.rotation, truth.normal)
    shading = lambert_shading(canonical_normal, truth.light)[:, 0, ..., None]
    error = 255 * ((truth.albedo * shading).clamp(max=1) - truth.image).abs()[truth.inside].ravel()
    assert error.median() < 1.6  # the set's README: 1.25 grey levels, 8-bit rounding and JPEG
    assert error.kthvalue(int(0.95 * len(error))).values < 7.0  # the README: 5.8


def test_normals_of_the_depth_are_the_stored_normals(truth):
    cosine = (normals_from_depth(truth.depth, 10.0) * truth.normal).sum(-1)[truth.inside]
    assert math.degrees(float(cosine.clamp(-1, 1).acos().median())) < 1.5  # the set's README: 0.9
