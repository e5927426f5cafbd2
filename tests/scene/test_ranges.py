"""Ranges of scene parameters: the published settings, what each bound lets through, what follows."""

import pytest

from derender.scene.ranges import SceneRanges


@pytest.mark.parametrize(
    ("name", "default", "accepted", "refused"),
    [
        ("fov_deg", 10, (0.5, 179.5), (0.0, 180.0)),
        ("depth_min", 0.9, (0.01, 1.09), (0.0, 1.1, 1.2)),
        ("depth_max", 1.1, (0.91, 1.5), (0.0, 0.9)),
        ("border_depth", 1.04, (0.01, 2.0), (0.0, -0.5)),
        ("border_share", 2 / 64, (0.0, 0.49), (-0.01, 0.5)),
        ("lean_deg", 0, (-79.5, 79.5), (-80.0, 80.0)),
        ("ambient", (0, 1), ((0.3, 0.3), (0.0, 0.5)), ((0.4, 0.3),)),
        ("diffuse", (0, 1), ((0.3, 0.3), (0.5, 1.0)), ((0.4, 0.3),)),
        ("light_deg", 45, (0.5, 89.5), (0.0, 90.0)),
        ("rotation_deg", 60, (0.5, 89.5), (0.0, 90.0)),
        ("translation_xy", 0.1, (0.0, 0.5), (-0.01,)),
        ("translation_z", 0, (0.0, 0.5), (-0.01,)),
    ],
)
def test_defaults_are_those_published_for_faces_and_bounds_let_through_what_is_possible(
    name, default, accepted, refused
):
    assert getattr(SceneRanges(), name) == pytest.approx(default)
    for value in accepted:
        assert getattr(SceneRanges(**{name: value}), name) == value
    for value in refused:
        with pytest.raises(ValueError, match=name):
            SceneRanges(**{name: value})


def test_the_border_keeps_its_share_of_any_width():
    assert [SceneRanges().border_columns(width) for width in (32, 64, 128, 256)] == [1, 2, 4, 8]
    assert SceneRanges(border_share=0.1).border_columns(64) == 6
