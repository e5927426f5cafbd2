"""The part of an image that a model should be shown."""

import numpy as np
import pytest
import torch
from torch.nn.functional import interpolate

import derender
from derender.render import Rendering
from derender.report.viewer.images import rendered_examples
from derender.scene.crop import WHOLE, Crop, best_crop, candidate_crops, crop_errors

TRUE = Crop(0.7, 0.1, 0.2)


def as_bytes(images: torch.Tensor) -> torch.Tensor:
    return (images * 255).round().to(torch.uint8)


@pytest.fixture(scope="module")
def model() -> derender.Derenderer:
    return derender.load("rendered-faces-64")


@pytest.fixture(scope="module")
def faces_known() -> torch.Tensor:
    """Two rendered faces that the model was tested on, (2, 3, 64, 64) in 0..1."""
    examples = rendered_examples("rendered-faces-64", 64)[:2]
    stacked = np.stack([example.picture for example in examples]).transpose(0, 3, 1, 2)
    return torch.from_numpy(stacked).float() / 255


@pytest.fixture(scope="module")
def laid_in(faces_known) -> torch.Tensor:
    """The same, each smaller and off the middle of a larger image with something else around it."""
    size = 160
    coarse = torch.rand(2, 3, 6, 6, generator=torch.Generator().manual_seed(0))
    canvas = interpolate(coarse, size=(size, size), mode="bicubic").clamp(0, 1)
    left, top, side = TRUE.corner(size)
    small = interpolate(faces_known, size=(side, side), mode="bilinear")
    canvas[:, :, top : top + side, left : left + side] = small
    return as_bytes(canvas)


def test_the_part_that_holds_what_the_model_knows_is_found(model, laid_in):
    results = [best_crop(model, one[None])[1] for one in laid_in]
    assert len(results) == 2 and all(abs(one.side - 0.7) < 0.11 for one in results)
    assert all(abs(one.across - 0.1) + abs(one.down - 0.2) < 0.21 for one in results)


def test_what_the_model_knows_as_it_is_stays_whole(model, faces_known):
    assert [best_crop(model, one[None])[1] for one in as_bytes(faces_known)] == [WHOLE, WHOLE]


def test_errors_are_shares_of_the_pictures_variance(model, faces_known):
    bytes_ = as_bytes(faces_known)
    pictures = bytes_.float() / 255
    with torch.inference_mode():
        seen = model.reconstruct(pictures)
    (result,) = crop_errors(model, bytes_, [WHOLE], batch_size=2)
    for row in range(2):
        inside = seen.mask[row] > 0
        target, drawn = pictures[row][:, inside].numpy(), seen.image[row][:, inside].numpy()
        variance = ((target - target.mean(axis=1, keepdims=True)) ** 2).sum()
        assert result[row] == pytest.approx(((target - drawn) ** 2).sum() / variance, rel=1e-3)


def test_a_plain_picture_and_one_with_nothing_in_it_have_an_answer(model, monkeypatch):
    plain = torch.full((2, 3, 128, 128), 90, dtype=torch.uint8)
    assert np.isfinite(crop_errors(model, plain, [WHOLE, TRUE])).all()

    def nothing(pictures):
        return Rendering(0 * pictures, *torch.zeros(2, *pictures[:, 0].shape))

    monkeypatch.setattr(model, "reconstruct", nothing)
    assert np.isinf(crop_errors(model, plain, [WHOLE, TRUE])).all()
    assert best_crop(model, plain) == (0, WHOLE)


def test_every_part_that_is_tried_lies_inside_the_picture():
    tried = candidate_crops()
    assert tried[0] == WHOLE and len(set(tried)) == len(tried) > 100
    for crop in tried:
        for size in (64, 128, 101):
            left, top, side = crop.corner(size)
            assert left >= 0 and top >= 0 and side >= 1 and max(left, top) + side <= size


@pytest.mark.parametrize(
    "numbers", [(0.0,), (1.1,), (0.7, 0.4), (0.7, 0, -0.4), (float("nan"),), (0.5, float("nan"))]
)
def test_a_part_beyond_the_picture_is_refused(numbers):
    with pytest.raises(ValueError, match="inside the image"):
        Crop(*numbers)


def test_a_cut_of_the_right_size_is_the_pixels_themselves():
    picture = torch.randint(0, 256, (1, 3, 80, 80), dtype=torch.uint8)
    part = Crop(0.8, -0.2, 0.2).cut(picture, 64)
    assert torch.equal(as_bytes(part), picture[:, :, 16:, :64])
    assert torch.equal(as_bytes(WHOLE.cut(picture, 80)), picture)
    assert Crop(0.5).cut(picture, 64).shape == (1, 3, 64, 64)
