"""The whole card: every control is there, seeds repeat it, shuffling takes everything away; its tables."""

import numpy as np
import pytest
from tests.evaluation.disentanglement.conftest import card

from derender.data import ImageSet
from derender.evaluation.disentanglement.card import dealt, disentangle, shuffled_rows
from derender.model import Derenderer


def model() -> Derenderer:
    return Derenderer.from_preset("small", seed=3, image_size=32, width=4, light_width=4, code_size=16).eval()


def lit_pictures(count: int = 60) -> ImageSet:
    """Ramps whose slopes are labelled as light: any encoder sees them."""
    rng = np.random.default_rng(0)
    slopes = rng.uniform(-1, 1, (count, 2)).astype(np.float32)
    axis = np.linspace(-1, 1, 32)
    ramps = 0.5 + 0.2 * (slopes[:, :1, None] * axis + slopes[:, 1:, None] * axis[:, None])
    images = np.repeat(ramps[:, None] * 255, 3, axis=1).astype(np.uint8)
    labels = {"light_yaw_rad": slopes[:, 0], "light_pitch_rad": slopes[:, 1]}
    return ImageSet(images, tuple(map(str, range(count))), labels)


def test_the_card_holds_the_model_and_every_control_and_repeats_itself():
    net, pictures, steps = model(), lit_pictures(), []
    how = {"seeds": (0, 1), "cache": "none", "progress": lambda *at: steps.append(at)}
    card = disentangle(net, pictures, swap_images=8, **how).result
    assert list(card.rows) == ["model", "untrained encoder", "shuffled rows", "random pixels", "PCA"]
    assert all(len(results) == 2 for results in card.rows.values()) and steps[-1] == (10, 10)
    assert card.features == ("geometry", "albedo", "light", "camera") and card.dimensions == (16,) * 4
    assert card.correlations.shape == (64, 64) and card.n_pictures == 60
    ours, untrained, shuffled, pixels, pca = (results[0] for results in card.rows.values())
    assert ours.swap is not None and ours.swap.n_pictures == 8 and untrained.swap is not None
    assert shuffled.swap is None and pixels.swap is None and pca.swap is None
    assert pca.pearson.mean_per_dimension < 1e-5  # components do not correlate, and that says nothing:
    assert pca.truth is not None and pca.truth.by_feature.informativeness > 0.8
    assert ours.truth is not None and ours.truth.by_dimension is not None and shuffled.truth is not None
    assert ours.truth.by_feature.informativeness > 0.8 > 0.2 > shuffled.truth.by_feature.informativeness
    assert ours.similarity.mean_cross_r2 > 0.5 > 0.1 > shuffled.similarity.mean_cross_r2
    again = disentangle(net, pictures, seeds=(0,), swap_images=8, dimensions=None, cache="none").result
    same = again.rows["untrained encoder"][0]
    assert same.swap is not None and same.swap.ratio == pytest.approx(untrained.swap.ratio, rel=1e-5)
    assert same.truth is not None and same.truth.by_dimension is None


def test_without_true_factors_only_their_part_is_missing():
    pictures = lit_pictures(20)
    real = ImageSet(pictures.images, pictures.files, {"age": pictures.labels["light_yaw_rad"]})
    card = disentangle(model(), real, seeds=(0,), swap_images=4, cache="none").result
    scores = card.rows["model"][0]
    assert scores.truth is None and np.isfinite(scores.pearson.mean_per_dimension)
    with pytest.raises(ValueError, match="at least one seed"):
        disentangle(model(), real, seeds=())


def test_controls_are_what_they_say():
    features = {"a": np.arange(12.0).reshape(6, 2), "b": np.arange(6.0)[:, None]}
    shuffled = shuffled_rows(features, 0)
    for name, values in features.items():
        assert sorted(map(tuple, shuffled[name])) == sorted(map(tuple, values))
    assert not np.array_equal(shuffled["a"][:, 0] / 2, shuffled["b"][:, 0])
    values = np.arange(24).reshape(2, 12)
    one, two = dealt(values, [5, 3], 0)
    assert one.shape == (2, 5) and two.shape == (2, 3)
    assert len({*one[0], *two[0]}) == 8 and np.array_equal(one[1], one[0] + 12)
    assert [part.shape[1] for part in dealt(values, [256, 256], 0)] == [6, 6]


def test_rows_are_means_with_the_spread_over_seeds_below():
    table = card().tables()[0]
    assert [row.name for row in table.rows] == ["model", "  ± 2 seeds", "shuffled rows", "  ± 2 seeds"]
    assert table.values()["model"]["swap"] == 4.5
    assert table.rows[1].cells[4] == "0.707" and table.rows[2].cells[4] is None
    assert "80 images" in table.caption and "2 seeds" in table.caption
    assert [row.name for row in card(1).tables()[0].rows] == ["model", "shuffled rows"]


def test_tables_against_the_true_factors():
    made = card()
    truth, _, single = made.tables()[3:]
    assert truth.values()["model"]["placed"] == 1 and truth.values()["shuffled rows"]["I"] < 0.1
    cells = single.values()["light yaw"]
    assert list(cells) == ["light", "camera", "all", "all, shuffled", "chance"]
    assert cells["light"] > 0.99 > 0.2 > cells["camera"] and cells["chance"] == 0
    assert len(card(known=False).tables()) == 3
