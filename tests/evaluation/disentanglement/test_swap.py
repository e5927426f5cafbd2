"""The swap test: the identity for a model that reads every factor, all alike for one that mixes them."""

from collections import namedtuple

import numpy as np
import pytest
import torch

from derender.evaluation.disentanglement.swap import diagonal_over_rest, swap_test
from derender.postprocess.embedding import Features
from derender.render import Rendering
from derender.scene import Scene

Named = namedtuple("Named", "name parameter")
FACTORS = tuple(Named(*pair) for pair in (("geometry", "depth"), ("albedo", "albedo"), ("light", "light")))


class Reader(torch.nn.Module):
    """Images of 4 x 4 whose rows 0, 1, 2 hold depth, albedo and light; ``mix`` adds every row to each."""

    factors, device, features = FACTORS, torch.device("cpu"), Features()

    def __init__(self, mix: float, covered: bool = True, frozen: bool = False):
        super().__init__()
        self.mix, self.covered, self.frozen, self.seen = mix, covered, frozen, []

    def activations(self, images, scenes=None):
        rows = [images[:, 0, row] * (0 if self.frozen and row == 2 else 1) for row in range(3)]
        mean = torch.stack(rows).sum(dim=0)
        names = (factor.name for factor in FACTORS)
        return {name: (1 - self.mix) * row + self.mix * mean for name, row in zip(names, rows, strict=True)}

    def codes(self, activations):
        return activations

    features_from = codes

    def without_features(self):
        return self

    def decode(self, codes):
        depth = codes["geometry"][:, None].expand(-1, 4, 4)
        albedo = codes["albedo"][:, None, None].expand(-1, 3, 4, 4)
        return Scene(depth, albedo, codes["light"], torch.zeros(len(depth), 6))

    def render(self, scene):
        image = torch.zeros(len(scene), 3, 4, 4)
        image[:, 0, 0], image[:, 0, 1] = scene.depth[:, 0], scene.albedo[:, 0, 0]
        image[:, 0, 2] = scene.light
        mask = torch.full((len(scene), 4, 4), float(self.covered))
        return Rendering(image * mask[:, None], scene.depth * mask, mask)


def pictures(count: int = 11) -> np.ndarray:
    return np.random.default_rng(0).integers(0, 256, (count, 3, 4, 4), dtype=np.uint8)


def test_a_model_that_reads_every_factor_gives_the_identity():
    scores = swap_test(Reader(0), pictures(), batch_size=4)
    np.testing.assert_allclose(scores.moved, np.eye(3), atol=1e-6)
    np.testing.assert_allclose(scores.moved_parameters, np.eye(3), atol=1e-6)
    np.testing.assert_allclose(scores.arrived, 0, atol=1e-6)
    np.testing.assert_allclose(scores.unexchanged, 0, atol=1e-6)
    assert scores.ratio == float("inf") and scores.factors == ("geometry", "albedo", "light")
    assert 0.3 < scores.moved_pixels.mean() < 0.9 and scores.n_pictures == 11


def test_features_that_hold_everything_move_alike_whatever_is_exchanged():
    scores = swap_test(Reader(1), pictures())
    np.testing.assert_allclose(scores.moved, scores.moved[:, :1].repeat(3, axis=1), rtol=1e-5)
    assert scores.ratio == pytest.approx(1, rel=1e-5)
    half = swap_test(Reader(0.3), pictures())
    assert 1.5 < half.ratio < 10 and (np.diag(half.moved) > half.moved.mean(axis=1)).all()
    rows = Reader(0.3).activations(torch.from_numpy(pictures()) / 255)
    again = swap_test(Reader(0.3), pictures(), known={name: each.numpy() for name, each in rows.items()})
    np.testing.assert_array_equal(again.moved, half.moved)


def test_uncovered_pixels_show_the_edge_of_the_picture_that_was_put_in():
    """With nothing covered, all that is left to see is the input's edge, which no exchange changes."""
    images = pictures()
    scores = swap_test(Reader(0, covered=False), images)
    np.testing.assert_allclose(scores.moved, 0, atol=1e-6)
    np.testing.assert_allclose(scores.moved_pixels, 0, atol=1e-6)
    assert np.isnan(scores.ratio)


def test_ratio_and_bad_input():
    assert diagonal_over_rest(np.array([[0.8, 0.1], [0.3, 0.4]])) == pytest.approx(3)
    with pytest.raises(ValueError, match="two images or more, got 1"):
        swap_test(Reader(0), pictures(1))
