"""Laws of what is measured: exact where an image can be made for which the answer is known."""

import numpy as np
import pytest
from tests.data.doctor import made

from derender.data.doctor import measures


def structure(images: np.ndarray) -> np.ndarray:
    return measures.structure_of(measures.edge_cells(measures.shrunk(images)))


def test_pixels_know_black_white_grey_and_blank():
    images = np.full((4, 3, 32, 32), 100, np.uint8)
    images[0, :, :8] = 0
    images[1, :, :, :16] = 255
    images[2, 0] = 200
    result = measures.measure_pixels(images)
    np.testing.assert_allclose(result.clipped, [0.25, 0.5, 0, 0])
    assert result.colourless.tolist() == [True, True, False, True]
    assert result.blank.tolist() == [False, False, True, True]
    np.testing.assert_allclose((result.tiny**2).sum(axis=1), [1, 1, 0, 0], atol=1e-5)


def test_an_edge_lies_in_its_cell_and_orientation():
    images = np.zeros((2, 3, 64, 64), np.uint8)
    images[0, :, :, 32:] = 255  # the gradient points right: orientation 0
    images[1, :, 32:] = 255  # down: orientation 4 of 8
    upright, level = measures.edge_cells(measures.shrunk(images))
    assert upright[:, [0, 1, 4, 5]].max() == 0 and upright[..., 1:].max() == pytest.approx(0, abs=1e-5)
    others = level[..., [0, 1, 2, 3, 5, 6, 7]].max()
    assert level[[0, 1, 4, 5]].max() == 0 and others == pytest.approx(0, abs=1e-5)
    assert upright[..., 0].max() > 1 and level[..., 4].max() > 1


def test_agreement_is_the_mean_over_pairs(numbers):
    rows = structure(made.noise(6, numbers))
    pairs = [(rows[i] * rows[j]).sum() for i in range(6) for j in range(6) if i != j]
    assert measures.agreement(rows) == pytest.approx(np.mean(pairs), abs=1e-6)
    assert measures.agreement(np.repeat(rows[:1], 4, axis=0)) == pytest.approx(1, abs=1e-5)


def test_symmetry_is_one_for_mirrored_pairs_and_unbiased_for_few(numbers):
    half = structure(made.generated("faces"))
    both = np.concatenate([half, measures.mirrored(half)])
    assert measures.symmetry(both) == pytest.approx(1, abs=0.02)
    few = [measures.symmetry(half[numbers.permutation(len(half))[:24]]) for _ in range(20)]
    assert np.mean(few) == pytest.approx(measures.symmetry(half), abs=0.03)
    assert measures.symmetry(structure(made.generated("from one side", 48))) < 0.5


@pytest.mark.parametrize("pixels", [-10, -4, 0, 6])
def test_the_axis_is_found_where_the_pictures_are_shifted_to(pixels):
    wide = np.pad(made.generated("faces"), ((0, 0), (0, 0), (0, 0), (10, 10)), mode="edge")
    shifted = wide[..., 10 - pixels : 74 - pixels]
    axis = measures.symmetry_axis(measures.shrunk(shifted))
    assert axis.offset * 64 == pytest.approx(pixels, abs=1)
    assert axis.correlation > 0.8


def test_frame_filled_counts_cells_with_common_structure():
    everywhere = np.full((50, 6, 6, 8), 1 / np.sqrt(288), np.float32)
    assert measures.frame_filled(everywhere) == pytest.approx(1)
    quarter = np.zeros((50, 6, 6, 8), np.float32)
    quarter[:, :3, :3] = 1 / np.sqrt(72)
    assert measures.frame_filled(quarter) == pytest.approx(0.25)


def test_view_variety_is_zero_for_own_mirror_images_and_one_for_strangers(numbers):
    images = made.noise(150, numbers)
    own = np.concatenate([images[..., :32], images[..., :32][..., ::-1]], axis=-1)
    assert measures.view_variety(structure(own)) == pytest.approx(0, abs=1e-3)
    assert measures.view_variety(structure(images)) == pytest.approx(1, abs=0.02)


def test_light_variety_is_the_spread_of_a_ramp(numbers):
    """Ramps of known slope: (left - right) / (left + right) of the middle's halves is known."""
    slope = numbers.normal(0, 0.2, 400).clip(-0.5, 0.5)
    across = np.linspace(-1, 1, 32)
    ramps = np.repeat(0.5 - 0.5 * slope[:, None, None] * across, 32, axis=1).astype(np.float32)
    distance = across[16:22].mean()
    expected = np.std(distance * slope * 0.5 / (0.5 + 0.01), ddof=1)
    assert measures.light_variety(measures.side_light(ramps)) == pytest.approx(expected, rel=0.1)
    assert (measures.side_light(ramps)[slope > 0.05] > 0).all(), "above 0 is lit from the left"
    flat = numbers.normal(0.5, 0.1, (400, 32, 32)).astype(np.float32)
    assert abs(measures.light_variety(measures.side_light(flat))) < 0.02


def test_near_copies_are_grouped_under_the_first(numbers):
    apart = made.landscapes(30, numbers)
    blank = np.full((2, 3, 64, 64), 9, np.uint8)
    images = np.concatenate([apart, made.copies(40, numbers), apart[:2], blank])
    group = measures.near_copy_groups(measures.measure_pixels(images).tiny)
    assert group[:30].tolist() == list(range(30))
    assert len(np.unique(group[30:70])) <= 4 and group[30:70].min() == 30
    assert group[70:72].tolist() == [0, 1]
    assert group[72:].tolist() == [72, 72], "blank images are copies of one another"
    assert measures.near_copy_groups(measures.measure_pixels(images[:1]).tiny).tolist() == [0]


def test_the_jackknife_of_a_mean_is_its_standard_error(numbers):
    values = numbers.normal(size=4800)
    result = measures.jackknife(lambda rows: float(values[rows].mean()), len(values))
    assert result.value == values.mean()
    assert result.error == pytest.approx(1 / np.sqrt(4800), rel=0.6)
    with pytest.raises(ValueError, match="needs 24 rows or more, got 23"):
        measures.jackknife(lambda rows: 0.0, 23)
