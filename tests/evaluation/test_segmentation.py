"""Nets beside controls on bands of colour at places that vary: they learn, they start as told, runs are
remembered, bad input is named."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from sklearn.metrics import accuracy_score, jaccard_score

from derender import Derenderer
from derender.data import ImageSet
from derender.evaluation import bootstrap, segmenters
from derender.evaluation.memory import Memory
from derender.evaluation.segmentation import COLUMNS, class_iou, count_pixels, resampled_scores, segment
from derender.evaluation.segmenters import (
    VARIANTS,
    SegmentationData,
    SegmentSettings,
    build_variant,
    by_components,
    divide,
)

DOUBLE = np.ones((2, 2), np.uint8)
QUICK = SegmentSettings(learning_rate=1e-2, epochs=6, batch_size=4)


COLOURS = np.array([[200, 30, 30], [30, 200, 30], [30, 30, 200], [120, 120, 120]], np.uint8)
NAMES = ("sky", "wall", "floor", "nothing")


def bands(count: int = 40, size: int = 32) -> tuple[ImageSet, np.ndarray]:
    """Bands of sky, wall and floor with edges that move; the fourth class is never shown."""
    random = np.random.default_rng(0)
    masks = np.zeros((count, size, size), np.uint8)
    for mask in masks:
        first, second = sorted(random.integers(4, size - 4, 2))
        mask[first:] = 1
        mask[second:] = 2
    images = np.moveaxis(COLOURS[masks], -1, 1).astype(int) + random.integers(-20, 20, (count, 3, size, size))
    files = tuple(f"{row:03d}.png" for row in range(count))
    return ImageSet(images.clip(0, 255).astype(np.uint8), files, source="made by the test"), masks


@pytest.fixture(scope="module")
def data() -> SegmentationData:
    return divide(*bands(), NAMES, test_fraction=0.4)


@pytest.fixture(scope="module")
def model() -> Derenderer:
    unets = {"encoder": "unet", "unet_width": 4, "unet_decoder": True}
    sizes = {"image_size": 32, "width": 4, "light_width": 4, **unets}
    return Derenderer.from_preset("small", seed=0, **sizes).eval().requires_grad_(False)


@pytest.fixture
def before(model):
    """Checks at the end that the model is as it was."""
    kept = {name: value.clone() for name, value in model.state_dict().items()}
    yield
    assert all(torch.equal(value, kept[name]) for name, value in model.state_dict().items())
    assert not any(parameter.requires_grad for parameter in model.parameters())


def mean_iou(answers, data) -> float:
    counts = count_pixels(answers, data.masks[data.test], len(data.classes))
    return resampled_scores(counts, np.ones((1, len(counts))))[0, 0]


def test_controls_answer_what_they_may_know(data):
    truth = data.masks[data.test]
    place = segmenters.most_frequent_at_place(data)
    column = [np.bincount(data.masks[data.train, row, 7]).argmax() for row in range(32)]
    assert (place == place[0]).all() and (place[0, :, 7] == column).all()
    blind = replace(data, images=np.full_like(data.images, 90))
    components = by_components(data)
    assert components.shape == truth.shape and components.dtype == np.uint8
    assert mean_iou(components, data) > mean_iou(place, data) + 0.05  # it sees where bands end
    assert (by_components(blind) == place).all()  # without an image, how often a class is at a place


@pytest.mark.parametrize("name", ["joint-whole", "joint", "joint-frozen", "random"])
def test_a_net_learns_and_leaves_the_model_alone(name, data, model, before):
    net = build_variant(model, VARIANTS[name], data, seed=0)
    told = []
    losses = segmenters.train_segmenter(net, data, 0, QUICK, lambda seen, loss: told.append(seen))
    assert losses[-1] < losses[0] and told[-1] == 6 * len(data.train)
    assert mean_iou(segmenters.answer(net, data.images[data.test]), data) > 0.5
    frozen = build_variant(model, VARIANTS[name], data, seed=0)
    pairs = zip(net.encoders.parameters(), frozen.encoders.parameters(), strict=True)
    assert all(torch.equal(*pair) for pair in pairs) == VARIANTS[name].frozen


def test_where_the_weights_come_from(data, model, before):
    built = {name: build_variant(model, variant, data, seed=3) for name, variant in VARIANTS.items()}
    ours = {name: model.nets[name].encoder.levels[0][0].weight for name in ("geometry", "albedo")}

    def starts(name):
        return [encoder.levels[0][0].weight for encoder in built[name].encoders]

    assert all(torch.equal(starts(name)[0], ours[name]) for name in ("geometry", "albedo"))
    for name in ("joint-whole", "joint", "joint-frozen"):
        assert torch.equal(starts(name)[0], ours["geometry"]) and torch.equal(starts(name)[1], ours["albedo"])
    fresh = [*starts("random"), *starts("joint-random")]
    assert not any(torch.equal(one, two) for one in fresh for two in ours.values())
    assert not torch.equal(*starts("joint-random"))
    for alike in (("geometry", "albedo", "random"), ("joint", "joint-frozen", "joint-random")):
        decoders = [built[name].decoder.to_outputs.weight for name in alike]
        assert all(torch.equal(decoders[0], other) for other in decoders)
    first = {name: net.decoder.upsample[0].weight for name, net in built.items()}
    own = model.unet_decoder.upsample[0].weight
    assert [name for name, weight in first.items() if torch.equal(weight, own)] == ["joint-whole"]
    assert {name for name, net in built.items() if not net.train().encoders[0].levels[0][1].training} == {
        "joint-whole", "joint", "geometry", "albedo", "joint-frozen"
    }  # fmt: skip
    other = build_variant(model, VARIANTS["random"], data, seed=4)
    assert not torch.equal(other.encoders[0].levels[0][0].weight, starts("random")[0])


def test_a_comparison_goes_on_where_it_stopped(data, model, tmp_path, before):
    settings, variants = QUICK.model_copy(update={"epochs": 1}), ["albedo", "random"]
    options = {"settings": settings, "resample_count": 20}
    first = Memory(tmp_path)
    segment(model, data, variants=["random"], seeds=(0,), memory=first, **options)
    assert (first.made, first.recalled) == (1, 0)
    second, told = Memory(tmp_path), []
    options |= {"variants": variants, "seeds": (0, 1)}
    scores = segment(model, data, memory=second, **options, progress=lambda *at: told.append(at))
    result = scores.result
    assert (second.made, second.recalled) == (3, 1)
    assert told[-1][:2] == (4 * len(data.train),) * 2
    again = segment(model, data, memory=Memory(tmp_path), **options).result
    for one, two in zip(result.rows, again.rows, strict=True):
        assert str(bootstrap.numbers_of([one.scored])) == str(bootstrap.numbers_of([two.scored]))
        assert (one.shown == two.shown).all() and (one.losses == two.losses).all()
    names = [row.scored.name for row in result.rows]
    assert names[:2] == ["albedo encoder", "random start"] and "each place's class" in names
    assert [row.scored.control for row in result.rows] == [False, True, True, True]
    assert result.rows[0].scored.runs == 2 and result.rows[0].losses.shape == (2, 1)
    shares = scores.values["test_share"]
    assert sum(shares.values()) == pytest.approx(1) and shares["nothing"] == 0
    changed = Memory(tmp_path)
    more = {"settings": QUICK.model_copy(update={"epochs": 2}), "resample_count": 20}
    segment(model, data, variants=["random"], seeds=(0,), memory=changed, **more)
    assert changed.recalled == 0

    table, _, classes, paper = scores.tables
    assert "24 images learned, 16 tested" in table.caption and "3 of 4 classes" in table.caption
    assert table.values()["each place's class"]["learn"] is None
    shown = classes.values()
    assert list(shown)[-1] == "nothing" and set(shown) == set(NAMES)
    assert "paper: Joint Encoders" in paper.values()


def test_the_split_is_the_datas_own_or_by_name():
    pictures, masks = bands(20)
    parts = np.array(["train"] * 8 + ["validation"] * 4 + ["test"] * 8)
    own = divide(replace(pictures, partition=parts), masks, NAMES)
    assert own.train.tolist() == list(range(8)) and own.test.tolist() == list(range(12, 20))
    hashed, other = divide(pictures, masks, NAMES), divide(pictures, masks, NAMES, split_seed=1)
    assert len(hashed.test) == 4 and set(hashed.train).isdisjoint(hashed.test)
    assert hashed.test.tolist() != other.test.tolist()
    few, more = (divide(pictures, masks, NAMES, labelled=count) for count in (4, 8))
    assert len(few.train) == 4 and set(few.train) < set(more.train) < set(hashed.train)
    assert few.test.tolist() == hashed.test.tolist()


def test_bad_input_is_named(data, model):
    pictures, masks = bands(20)
    with pytest.raises(ValueError, match="labelled=99 training images, but there are 16"):
        divide(pictures, masks, NAMES, labelled=99)
    with pytest.raises(ValueError, match="leaves 1 images to learn from and 1 to test on"):
        divide(pictures.select([0, 1]), masks[:2], NAMES, test_fraction=0.5)
    without = Derenderer.from_preset("small", seed=0, image_size=32, encoder="unet", unet_width=4)
    with pytest.raises(ValueError, match="the model has no U-Net decoder: make a copy that has with"):
        segment(without, data, variants=["joint-whole"])
    large = replace(data, images=np.zeros((40, 3, 64, 64), np.uint8), masks=np.kron(data.masks, DOUBLE))
    with pytest.raises(ValueError, match="the images are 64x64, the model takes 32x32"):
        segment(model, large, variants=["geometry"])


def scores(answers, masks, n_classes=4) -> SimpleNamespace:
    counts = count_pixels(np.asarray(answers), np.asarray(masks), n_classes)
    values = resampled_scores(counts, np.ones((1, len(counts))))[0]
    named = dict(zip(COLUMNS, values, strict=True))
    return SimpleNamespace(**named, class_iou=class_iou(counts))


def test_a_class_that_no_mask_shows_is_left_out_for_every_answer():
    masks = np.array([[[0, 0], [1, 1]]], np.uint8)
    right, wrong = masks.copy(), np.array([[[0, 3], [1, 1]]], np.uint8)
    assert scores(right, masks).mean_iou == 1
    result = scores(wrong, masks)
    assert result.class_iou == pytest.approx([0.5, 1, np.nan, np.nan], nan_ok=True)
    assert result.mean_iou == 0.75 == result.top10_iou


def test_they_are_those_of_scikit_learn():
    random = np.random.default_rng(0)
    masks = random.integers(0, 19, (70, 6, 5)).astype(np.uint8)
    answers = np.where(random.random(masks.shape) < 0.5, masks, random.integers(0, 19, masks.shape))
    result = scores(answers.astype(np.uint8), masks, 19)
    each = jaccard_score(masks.ravel(), answers.ravel(), average=None)
    assert result.class_iou == pytest.approx(each, abs=1e-6)
    assert result.mean_iou == pytest.approx(each.mean(), abs=1e-6)
    assert result.top10_iou == pytest.approx(np.sort(each)[-10:].mean(), abs=1e-6)
    assert result.pixel_accuracy == pytest.approx(accuracy_score(masks.ravel(), answers.ravel()), abs=1e-6)


def test_resamples_are_scores_of_the_pictures_drawn_with_the_same_ten_classes():
    random = np.random.default_rng(1)
    masks = random.integers(0, 3, (6, 4, 4)).astype(np.uint8)
    answers = random.integers(0, 3, masks.shape).astype(np.uint8)
    counts, drawn = count_pixels(answers, masks, 4), [0, 0, 3, 5]
    weights = np.bincount(drawn, minlength=6)[None]
    result = scores(answers[drawn], masks[drawn])
    expected = [result.mean_iou, result.mean_iou, result.pixel_accuracy]
    assert resampled_scores(counts, weights)[0] == pytest.approx(expected)
