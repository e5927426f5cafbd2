"""Maps over the image: where a network looks, what changes them, exact sums."""

import numpy as np
import pytest
import torch
from torch import nn

from derender.interpretation import attribution
from derender.interpretation.attribution import METHODS, UNCHANGED, saliency, sanity_check, score
from derender.interpretation.probe import Probe
from derender.model import Derenderer
from derender.networks.encoders import activations
from derender.postprocess import Features
from derender.postprocess.embedding import CELLS, HISTOGRAMS
from derender.postprocess.whitening import Projection, Whitening
from derender.presets import MODEL_PRESETS

SIZE, CODE = 32, 6


class QuadrantEncoder(nn.Module):
    """Looks at the upper left quarter only: by what it takes in, or by what it reads from its features."""

    def __init__(self, where: str):
        super().__init__()
        self.where = where
        self.convolution = nn.Conv2d(3, 4, 8, stride=8, bias=False)
        self.to_code = nn.Sequential(nn.Conv2d(4, CODE, 4, bias=False), nn.ReLU())
        with torch.no_grad():
            self.convolution.weight.fill_(0.1)
            weight = self.to_code[0].weight.fill_(0.1)
            if where == "code":
                weight[:, :, 2:] = 0
                weight[:, :, :, 2:] = 0

    def spatial(self, images: torch.Tensor) -> torch.Tensor:
        seen = torch.zeros_like(images)
        seen[:, :, : SIZE // 2, : SIZE // 2] = 1
        return self.convolution(images * seen if self.where == "input" else images)

    def forward(self, images: torch.Tensor) -> torch.Tensor:
        return self.to_code(self.spatial(images)).flatten(1)


class Looking:
    """As much of a model as maps need."""

    def __init__(self, where: str):
        net = nn.Module()
        net.encoder = QuadrantEncoder(where)
        net.encode = net.encoder.forward
        self.nets, self.features = {"geometry": net}, Features()

    def factor_activations(self, name: str, images: torch.Tensor) -> torch.Tensor:
        encoder = self.nets[name].encoder
        return activations(encoder(images), encoder.spatial(images))

    def features_from(self, result: dict[str, torch.Tensor]) -> dict[str, torch.Tensor]:
        return {name: value[:, :CODE] for name, value in result.items()}


@pytest.fixture
def images(generator) -> torch.Tensor:
    return torch.rand(3, 3, SIZE, SIZE, generator=generator) * 0.5 + 0.25


YES = Probe("labels", ("a",), {"geometry": CODE}, np.ones((1, CODE), np.float32), np.zeros(1, np.float32))


def share_in_quadrant(maps: torch.Tensor) -> float:
    half = maps.shape[-1] // 2
    return float(maps[:, :half, :half].sum() / maps.sum())


def test_grad_cam_misleads_where_hires_cam_does_not(images):
    """The features light up everywhere, the code reads a quarter of them: Grad-CAM cannot tell."""
    model = Looking("code")
    told = {m: share_in_quadrant(saliency(m, model, images, "geometry", YES, [0, 0, 0])) for m in METHODS}
    assert told["hires-cam"] == pytest.approx(1, abs=1e-5) and told["pixels"] == pytest.approx(1, abs=1e-5)
    assert told["grad-cam"] < 0.4


def test_pixels_sum_to_the_change_of_the_answer(images):
    """This network is linear where its ReLU is open, so the error is rounding."""
    weight = torch.ones(3, CODE)
    maps = attribution.pixel_attribution(Looking("input"), images * 0.4 + 0.55, "geometry", weight)
    encode = Looking("input").nets["geometry"].encode
    grey = torch.full_like(images, 0.5)
    change = score(encode(images * 0.4 + 0.55), weight) - score(encode(grey), weight)
    torch.testing.assert_close(maps.sum(dim=(1, 2)), change.detach(), rtol=1e-3, atol=1e-4)


@pytest.fixture(scope="module")
def model() -> Derenderer:
    settings = MODEL_PRESETS["small"]
    sizes = {"image_size": SIZE, "width": 4, "light_width": 4, "code_size": CODE}
    network = settings.network.model_copy(update=sizes)
    made = Derenderer.seeded(settings.model_copy(update={"network": network}), 0)
    return made.eval().requires_grad_(False)


@pytest.fixture(scope="module")
def probe(model) -> Probe:
    names = tuple(factor.name for factor in model.factors)
    weight = np.random.default_rng(0).standard_normal((2, CODE * len(names))).astype(np.float32)
    return Probe("labels", ("a", "b"), dict.fromkeys(names, CODE), weight, np.zeros(2, np.float32))


def test_hires_cam_before_its_rectifier_sums_to_the_answer(model, probe, images):
    """Features to code to logit is piecewise linear without bias: gradient times feature is the logit."""
    for factor in probe.factors:
        weight = torch.from_numpy(probe.weight[[0, 1, 0], probe.slices[factor]])
        encoder = model.nets[factor].encoder
        with torch.enable_grad():
            features = encoder.spatial(images).requires_grad_()
            code = encoder.to_code(features).flatten(1)
            (gradient,) = torch.autograd.grad(score(code, weight).sum(), features)
        torch.testing.assert_close((gradient * features).sum(dim=(1, 2, 3)), score(code, weight))
        expected = (gradient * features).sum(dim=1).relu()
        torch.testing.assert_close(saliency("hires-cam", model, images, factor, probe, [0, 1, 0]), expected)


def test_features_of_both_sides_give_a_mirrored_picture_the_mirrored_map(model, probe, images):
    width, names = model.activations(images[:1])["geometry"].shape[1], ("geometry", "albedo")
    draw = torch.Generator().manual_seed(0)
    drawn = {name: torch.randn(width, CODE, generator=draw) for name in names}
    maps = {name: Projection(torch.zeros(width), one, torch.ones(CODE)) for name, one in drawn.items()}
    mirroring = model.with_features(Features(Whitening(maps, mirrored=maps)))
    for method in METHODS:
        sides = (images, images.flip(-1))
        own, mirror = (saliency(method, mirroring, one, "albedo", probe, [0, 1, 0]) for one in sides)
        torch.testing.assert_close(own, mirror.flip(-1), rtol=1e-3, atol=1e-5)
        assert not torch.allclose(own, own.flip(-1), rtol=1e-2)


@pytest.mark.parametrize("method", METHODS)
def test_gradients_that_count_for_nothing_change_no_map(model, probe, images, method):
    plain = model.activations(images[:1])["albedo"].shape[1]
    both = plain + 2 * CELLS**2 + HISTOGRAMS  # as in the bundled faces-64
    chart = torch.randn(both, CODE, generator=torch.Generator().manual_seed(0))
    chart[plain:] = 0
    maps = []
    for width in (plain, both):
        whitening = Whitening({"albedo": Projection(torch.zeros(width), chart[:width], torch.ones(CODE))})
        featured = model.with_features(Features(whitening))
        maps.append(saliency(method, featured, images, "albedo", probe, [0, 1, 0]))
    torch.testing.assert_close(maps[0], maps[1])


def test_new_weights_change_the_map_and_the_same_weights_do_not(model, probe, images):
    targets = np.zeros(3, np.int64)
    result = sanity_check(model, probe, probe, images, targets, methods=("pixels", "hires-cam"), seeds=(1, 2))
    by = {(row.method, row.factor, row.changed): row for row in result}
    assert len(by) == 2 * 4 * 3
    for factor in probe.factors:
        kept = by["pixels", factor, "shuffled labels"]  # the very same probe: nothing was changed
        assert kept.spearman == pytest.approx(1) and kept.ssim == pytest.approx(1, abs=1e-5)
        assert by["pixels", factor, "random weights"].spearman < 0.9
    again = sanity_check(model, probe, probe, images, targets, methods=("pixels",), seeds=(1, 2))
    assert again == [row for row in result if row.method == "pixels"]


def test_a_map_that_ignores_the_weights_is_not_trusted():
    edges, other = torch.rand(2, 3, SIZE, SIZE, generator=torch.Generator().manual_seed(1))
    flat, told = torch.zeros_like(edges), ("geometry", "random weights", edges)
    row = attribution.similarity("edges", *told, [edges * 2, edges.square()], SIZE)
    assert row.spearman == pytest.approx(1)
    assert attribution.similarity("noise", *told, [other], SIZE).spearman < UNCHANGED
    row = attribution.similarity("flat", *told, [flat], SIZE)
    assert row.empty == 1 and np.isnan(row.spearman)


def test_known_maps(model, images):
    """Rank correlation, upsampling, and the feature itself where there is no probe."""
    up = torch.arange(9.0).reshape(1, 3, 3)
    assert [attribution.spearman(up, other)[0] for other in (up.exp(), -up)] == pytest.approx([1, -1])
    assert np.isnan(attribution.spearman(up, torch.ones(1, 3, 3))[0])
    torch.testing.assert_close(attribution.upsampled(torch.ones(1, 4, 4), 9), torch.ones(1, 9, 9))
    corner = torch.zeros(1, 4, 4)
    corner[0, 0, 3] = 1
    assert divmod(int(attribution.upsampled(corner, 32)[0].argmax()), 32) == (0, 28)
    maps = saliency("grad-cam", model, images, "light")
    assert maps.shape == (3, 4, 4) and bool((maps >= 0).all()) and float(maps.max()) > 0
