"""Ranges of scene parameters: the published settings, what each bound lets through, what follows."""

import math

import pytest

from derender.scene.ranges import SceneRanges


def test_defaults_are_the_published_settings_for_faces():
    assert SceneRanges().model_dump() == {
        "fov_deg": 10.0,
        "depth_min": 0.9,
        "depth_max": 1.1,
        "border_depth": pytest.approx(1.04),
        "border_share": 0.03125,
        "level_depth": False,
        "lean_deg": 0.0,
        "ambient": (0.0, 1.0),
        "diffuse": (0.0, 1.0),
        "light_deg": 45.0,
        "rotation_deg": 60.0,
        "translation_xy": 0.1,
        "translation_z": 0.0,
    }


@pytest.mark.parametrize(
    ("name", "accepted", "refused"),
    [
        ("fov_deg", (0.5, 179.5), (0.0, 180.0)),
        ("depth_min", (0.01, 1.09), (0.0, 1.1, 1.2)),
        ("depth_max", (0.91, 1.5), (0.0, 0.9)),
        ("border_depth", (0.01, 2.0), (0.0, -0.5)),
        ("border_share", (0.0, 0.49), (-0.01, 0.5)),
        ("lean_deg", (-79.5, 79.5), (-80.0, 80.0)),
        ("ambient", ((0.3, 0.3), (0.0, 0.5)), ((0.4, 0.3),)),
        ("diffuse", ((0.3, 0.3), (0.5, 1.0)), ((0.4, 0.3),)),
        ("light_deg", (0.5, 89.5), (0.0, 90.0)),
        ("rotation_deg", (0.5, 89.5), (0.0, 90.0)),
        ("translation_xy", (0.0, 0.5), (-0.01,)),
        ("translation_z", (0.0, 0.5), (-0.01,)),
    ],
)
def test_each_bound_lets_through_what_is_possible_and_nothing_else(name, accepted, refused):
    for value in accepted:
        assert getattr(SceneRanges(**{name: value}), name) == value
    for value in refused:
        with pytest.raises(ValueError, match=name):
            SceneRanges(**{name: value})


def test_the_border_keeps_its_share_of_any_width():
    assert [SceneRanges().border_columns(width) for width in (32, 64, 128, 256)] == [1, 2, 4, 8]
    assert SceneRanges(border_share=0.1).border_columns(64) == 6


def test_the_slope_of_light_is_the_tangent_of_its_angle():
    assert SceneRanges().light_slope == pytest.approx(1)
    assert SceneRanges(light_deg=60.0).light_slope == pytest.approx(math.sqrt(3))
