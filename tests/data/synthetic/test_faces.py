"""Procedural faces: reproducible to the byte, and every truth map explains its image."""

from itertools import combinations

import numpy as np
import pytest
import torch
from tests.data.synthetic.test_generated import inner

from derender.data.layouts.faces import MASK_CLASSES
from derender.data.synthetic import VIEWS, FaceSettings, LightSettings, ViewSettings, faces
from derender.data.synthetic.morphable import NOSE_TIP_Z
from derender.data.synthetic.synthetic_set import SyntheticSet
from derender.render import render

AHEAD = VIEWS["frontal"]
STILL = {"expressions": ("neutral",), "asymmetry": 0.0, "gaze_px": 0.0}
EVEN_LIGHT = LightSettings(yaw_deg=(0, 0), pitch_deg=(0, 0), ambient=(0.6, 0.6), diffuse=(0.3, 0.3))


def test_neutral_faces_are_symmetric_with_the_nose_tip_in_place():
    still = faces.generate(16, seed=6, settings=FaceSettings(**STILL, view=AHEAD, pictures_per_identity=1))
    bare = still.mask & (still.parts != MASK_CLASSES.index("hair"))  # hair may be parted
    apart = np.abs(still.depth - still.depth[..., ::-1])[inner(bare & bare[..., ::-1], 3)]
    assert np.percentile(apart, 99) < 5e-4 and np.median(apart) < 2e-5
    tip = still.depth[:, 24:42, 26:38].min(axis=(1, 2))
    assert np.allclose(tip, NOSE_TIP_Z, atol=1.5e-3)


def test_people_differ_and_pictures_of_one_person_agree_without_light():
    settings = FaceSettings(**STILL, view=AHEAD, pictures_per_identity=2)
    people = faces.generate(24, seed=7, settings=settings)
    assert (people.albedo[::2] == people.albedo[1::2]).all()
    assert (people.depth[::2] == people.depth[1::2]).all()
    assert (people.images[::2] != people.images[1::2]).any(axis=(1, 2, 3)).all()
    first = people.albedo[::2].astype(float)
    between = np.abs(first[:, None] - first[None]).mean(axis=(2, 3, 4))
    assert between[~np.eye(12, dtype=bool)].min() > 4.0
    shape = people.depth[::2, 16:56, 16:48]
    apart = np.abs(shape[:, None] - shape[None]).mean(axis=(2, 3))
    assert apart[~np.eye(12, dtype=bool)].min() > 5e-4
    traits = people.identity_traits
    assert all((values[::2] == values[1::2]).all() for values in traits.values())
    assert len(set(traits["shape_nose_length"].tolist())) == 12


def test_each_expression_changes_the_face_in_its_own_way():
    common = {"view": AHEAD, "light": EVEN_LIGHT, "strength": (1.0, 1.0), "asymmetry": 0.0, "gaze_px": 0.0}
    alone = {name: FaceSettings(**common, expressions=(name,)) for name in FaceSettings().expressions}
    shown = {name: faces.generate(3, seed=8, settings=settings).depth for name, settings in alone.items()}
    for a, b in combinations(shown, 2):
        apart = np.abs(shown[a] - shown[b])[:, 8:56, 14:50]
        assert apart.max(axis=(1, 2)).min() > 2e-3, (a, b)


def test_settings_are_respected():
    settings = FaceSettings(
        view=ViewSettings(yaw_deg=(22, 38), yaw_sd_deg=5),
        light=LightSettings(yaw_deg=(50, 70), ambient=(0.1, 0.2), diffuse=(0.9, 1.0)),
        expressions={"happiness": 3, "fear": 1}, pictures_per_identity=3, first_identity=7,
        age_years=(30, 40), skin_tone=(0.5, 0.6),
    )  # fmt: skip
    made = faces.generate(60, image_size=16, settings=settings)
    yaw, light = np.rad2deg(made.camera[:, 1]), made.light
    assert yaw.min() >= 21.99 and yaw.max() <= 38.01 and yaw.std() > 1
    assert np.rad2deg(light[:, 3]).min() >= 49.99 and np.rad2deg(light[:, 3]).max() <= 70.01
    assert 0.099 <= light[:, 0].min() <= light[:, 0].max() <= 0.201
    assert 0.899 <= light[:, 1].min() <= light[:, 1].max() <= 1.0
    assert set(made.expression.tolist()) == {"happiness", "fear"}
    assert 0.6 < (made.expression == "happiness").mean() < 0.9
    assert made.identity.tolist() == [7 + i // 3 for i in range(60)]
    assert 30 <= made.labels["age"].min() < made.labels["age"].max() <= 40
    assert 0.5 <= made.labels["skin_tone"].min() <= made.labels["skin_tone"].max() <= 0.6


def test_a_track_keeps_light_and_person_while_the_head_moves_smoothly():
    settings = FaceSettings(tracks=3, frames=5, expressions=("happiness",), backgrounds=("plain",))
    made = faces.generate(30, image_size=32, seed=2, settings=settings)
    assert made.identity.tolist() == [0] * 15 + [1] * 15
    assert made.labels["track"].tolist() == [i // 5 % 3 for i in range(30)]
    assert made.labels["frame"].tolist() == [i % 5 for i in range(30)]
    light, camera = made.light.reshape(6, 5, 4), made.camera.reshape(6, 5, 6)
    assert (light == light[:, :1]).all() and len(np.unique(light[:, 0], axis=0)) == 6
    step = np.abs(np.diff(camera, axis=1))
    whole = np.abs(camera[:, -1] - camera[:, 0])
    assert whole[:, :3].max(axis=1).min() > 0.02 and np.rad2deg(whole[:, 1]).max() <= 18.01
    assert (step.sum(axis=1) <= whole + 1e-6).all()  # no way back
    assert (made.labels["strength"].reshape(6, 5).std(axis=1) > 1e-4).all()
    again = faces.generate(4, image_size=32, seed=2, settings=settings, first=17)
    assert (again.images == made.images[17:21]).all()


@pytest.mark.parametrize(
    ("view", "right", "wrong"),
    [(AHEAD, 2.5, 6.0), (ViewSettings(yaw_deg=(-15, 15), pitch_deg=(-8, 8)), 4.0, 8.0)],
    ids=["the image's own frame", "the canonical maps turned by the stored camera"],
)
def test_rendering_the_truth_again_gives_the_picture(view, right, wrong):
    """Through the project's own renderer; with another light or camera it does not."""
    made = faces.generate(12, seed=3, settings=FaceSettings(view=view))
    ahead = faces.generate(12, seed=3, settings=FaceSettings(view=AHEAD))
    depth = torch.from_numpy(np.where(ahead.mask, ahead.depth, 1.15))
    albedo = torch.from_numpy(ahead.albedo / np.float32(255))
    light, camera = torch.from_numpy(made.light), torch.from_numpy(made.camera)
    again = render(depth, albedo, light, camera)
    other = render(depth, albedo, light * torch.tensor([1, 1, -1, -1]) if view is AHEAD else light, -camera)
    assert np.median(grey_levels_apart(again.image, made)) < right
    assert np.median(grey_levels_apart(other.image, made)) > wrong


def grey_levels_apart(image: torch.Tensor, made: SyntheticSet) -> np.ndarray:
    """Differences well inside the face, as the image stores them."""
    return np.abs(image.clamp(0, 1).numpy() * 255 - made.images).mean(axis=1)[inner(made.mask, 3)]


def test_parts_are_where_they_belong():
    frontal = FaceSettings(**STILL, view=AHEAD, pictures_per_identity=1)
    made = faces.generate(24, seed=12, settings=frontal)
    assert made.part_names == MASK_CLASSES
    assert ((made.parts > 0) == made.mask).all()
    rows, columns = np.mgrid[:64, :64]

    def centre(name: str) -> np.ndarray:
        """(faces, 2): mean row and column of a part, NaN where fewer than three pixels show it."""
        seen = made.parts == MASK_CLASSES.index(name)
        size = seen.sum(axis=(1, 2)).astype(float)
        size[size < 3] = np.nan
        return np.stack([(seen * at).sum(axis=(1, 2)) / size for at in (rows, columns)], axis=1)

    left, right, nose = centre("l_eye"), centre("r_eye"), centre("nose")
    assert np.isfinite(left).all() and np.isfinite(nose).all()
    assert (left[:, 1] > 38).all() and (right[:, 1] < 25).all()  # the person's own left
    assert (nose[:, 0] > left[:, 0] + 5).all() and abs(nose[:, 1] - 31.5).max() < 2
    upper, lower, hair, neck = centre("u_lip"), centre("l_lip"), centre("hair"), centre("neck")
    assert (lower[:, 0] > upper[:, 0] + 1).all() and (upper[:, 0] > nose[:, 0] + 5).all()
    assert np.nanmax(hair[:, 0] - nose[:, 0]) < 12 and np.nanmin(neck[:, 0] - lower[:, 0]) > 5
    assert np.isnan(hair[:, 0]).sum() == (made.labels["hair"] == "bald").sum()
    brow = centre("l_brow")
    assert np.nanmax(brow[:, 0] - left[:, 0]) < -2
    assert not (made.parts == MASK_CLASSES.index("mouth")).any()
    loud = FaceSettings(view=AHEAD, expressions=("surprise",), strength=(1, 1), pictures_per_identity=1)
    surprised = faces.generate(8, seed=12, settings=loud)
    assert ((surprised.parts == MASK_CLASSES.index("mouth")).sum(axis=(1, 2)) > 10).all()
