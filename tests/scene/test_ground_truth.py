"""The conventions against images somebody else rendered: synface64's exact depth, normals and light."""

import csv
import io
import math
import zipfile

import numpy as np
import pytest
import torch
from torch import Tensor
from torch.nn.functional import max_pool2d

from derender.data import GroundTruth, read_ground_truth
from derender.scene.camera import rotation_matrix
from derender.scene.light import lambert_shading, light_direction
from derender.scene.normals import normals_from_depth

COUNT = 64


@pytest.fixture(scope="module")
def truth(shared_data) -> GroundTruth:
    return read_ground_truth(shared_data("data/synface64.zip"), limit=COUNT)


@pytest.fixture
def inside(truth) -> Tensor:
    """The masks, eroded by one pixel."""
    inside = max_pool2d((~torch.from_numpy(truth.mask)).float()[:, None], 3, 1, 1)[:, 0] == 0
    inside[:, [0, -1]] = False
    inside[:, :, [0, -1]] = False
    return inside


def rotation_of(truth: GroundTruth) -> Tensor:
    return rotation_matrix(torch.from_numpy(truth.camera[:, :3]))


def test_light_directions_are_those_stored(truth, shared_data):
    with zipfile.ZipFile(shared_data("data/synface64.zip")) as archive:
        table = csv.DictReader(io.StringIO(archive.read("test_gt/params.csv").decode()))
    rows = {f"test_gt/{row['file']}": row for row in table}

    def columns(*names: str) -> Tensor:
        return torch.tensor([[float(rows[file][name]) for name in names] for file in truth.files])

    direction = light_direction(torch.from_numpy(truth.light))
    assert len(truth) == COUNT
    assert (direction - columns("lx", "ly", "lz")).abs().max() < 2e-6  # stored with 6 digits
    turned = (rotation_of(truth) @ direction[..., None])[..., 0]
    assert (turned - columns("lx_cam", "ly_cam", "lz_cam")).abs().max() < 2e-6


def test_albedo_times_shading_is_the_image(truth, inside):
    canonical_normal = torch.einsum("nij,nhwi->nhwj", rotation_of(truth), torch.from_numpy(truth.normal))
    shading = lambert_shading(canonical_normal, torch.from_numpy(truth.light)).numpy()
    apart = np.abs((truth.albedo * shading).clip(max=1) * 255 - truth.images).transpose(0, 2, 3, 1)
    error = apart[inside.numpy()].ravel()
    assert np.median(error) < 1.6  # the set's README: 1.25 grey levels, 8-bit rounding and JPEG
    assert np.percentile(error, 95) < 7.0  # the README: 5.8


def test_normals_of_the_depth_are_the_stored_normals(truth, inside):
    assert 0.93 < truth.depth[truth.mask].min() < truth.depth[truth.mask].max() < 1.16
    seen = normals_from_depth(torch.from_numpy(truth.depth), 10.0)
    cosine = (seen * torch.from_numpy(truth.normal)).sum(-1)[inside]
    assert math.degrees(float(cosine.clamp(-1, 1).acos().median())) < 1.5  # the set's README: 0.9
