"""Features of a trained model, estimated on its training images: whitening, then test-time fitting.

Whitening: how other factors move a model's activations, measured on its own renderings. For geometry and
albedo every image is decomposed, rendered with other values of all its vector factors (light and camera), and
encoded again, several times. Where the settings say so, images are framed as training images are, but for
the errors of framing. Geometry is then encoded from the canonical view. Mirror images count as views, too,
for the object is symmetric. For each vector factor everything but that factor is changed: maps are another
image's. Leaves out changing one map beside the other, which brought nothing (lab/log.md). Brightness: the
prior that shares it between albedo and light.
Fitting: a morphable model of the predicted depths and albedos, within which postprocess/fitting.py optimises.
"""

from collections.abc import Mapping
from dataclasses import replace

import torch
from jaxtyping import Float, Shaped
from torch import Generator, Tensor

from derender.data import Progress
from derender.model import Derenderer
from derender.postprocess.embedding import HISTOGRAM_CELLS, HISTOGRAMS, Features
from derender.postprocess.fitting import PARAMETERS, Fitting, FittingSettings, MorphableMaps
from derender.postprocess.whitening import Scatter, Whitening, fit_projection, fit_side_by_side
from derender.scene.brightness import BrightnessPrior, brightness_cues
from derender.scene.crop import crop_images, similarities
from derender.scene.perturb import PerturbSettings
from derender.training.config import FeatureSettings, WhiteningSettings
from derender.training.framing import fit_framing
from derender.training.process import evaluating
from derender.training.views import batches, photographs, renderings

BRIGHTNESS_IMAGES = 8000
TURNED_SHARE = 0.5  # of its variance, kept by geometry of the canonical view: its camera errs in strong light
FRAMING_ERRORS = (0.02, 0.02, 0.015, 0.01)  # of a framed image: logarithm of scale, roll (radians), place
LENGTH_IMAGES = 256  # that are fitted to measure the length of fitted coordinates, where features hold them


def make_features(
    model: Derenderer, images: Shaped[Tensor, "n 3 h w"], settings: FeatureSettings, *, seed: int = 0,
    progress: Progress | None = None, maps: MorphableMaps | None = None,
) -> Derenderer:  # fmt: skip
    """A model that shares these weights, with whitening and fitting as far as the settings have them.

    A feature keeps the size of the code: fitted coordinates leave the rest of it to activations. Images are
    training images, uint8 or float in 0..1, of which ``seed`` draws subsets; ``maps`` to fit scenes within
    are by default estimated here. Too few images or too many coordinates are a ValueError.
    """
    size, fitting = model.settings.network.code_size, settings.fitting
    model = model.with_features(Features(model.whitening)).with_brightness(None)
    if fitting.steps and (size := size - fitting.coordinates) < 1:
        none = f"none of a feature's {size + fitting.coordinates} numbers to activations"
        raise ValueError(f"{fitting.coordinates} fitted coordinates leave {none}: set coordinates lower")
    if settings.whitening.pictures >= 2:
        how = settings.whitening, settings.perturb
        whitening = fit_whitening(model, images, *how, size=size, seed=seed, progress=progress)
        model = model.with_features(Features(whitening))
    if fitting.examples >= 2 and PARAMETERS.keys() <= {factor.name for factor in model.factors}:
        made = make_fitting(model, images, fitting, seed=seed, progress=progress, maps=maps)
        model = model.with_features(Features(model.whitening, made))
    return model.with_brightness(fit_brightness(model, images) if settings.brightness else None)


@torch.no_grad()
def fit_brightness(model: Derenderer, images: Shaped[Tensor, "n 3 h w"]) -> BrightnessPrior | None:
    """The prior of brightness over the first images; None for fewer than four or another kind of scene."""
    model, result = model.with_brightness(None), []
    moves = model.renderer.specular is not None or model.renderer.gamma != 1  # brightness would change images
    if len(images) < 4 or moves or {"light", "albedo"} - {factor.parameter for factor in model.factors}:
        return None
    with evaluating(model):
        for _, batch in batches(model, images, torch.arange(min(len(images), BRIGHTNESS_IMAGES)), None):
            result.append(brightness_cues(model.decompose(batch)).cpu())
    return BrightnessPrior.of(torch.cat(result))


@torch.no_grad()
def fit_whitening(
    model: Derenderer, images: Shaped[Tensor, "n 3 h w"], settings: WhiteningSettings,
    perturb: PerturbSettings, *, size: int | None = None, seed: int = 0, progress: Progress | None = None,
) -> Whitening:  # fmt: skip
    """The map from a trained model's activations to its features; arguments as of `make_features`.

    A framing network that the model has already is kept, where the settings ask for one. ``size`` is that of
    the features, by default the code's. Fewer than two images, or activations that are not finite, are a
    ValueError.
    """
    generator = Generator().manual_seed(seed)
    others = Generator().manual_seed(seed)  # of the vector factors: it changes no other feature
    rows = torch.randperm(len(images), generator=generator)[: settings.pictures]
    if not len(rows):
        raise ValueError("whitening needs at least 2 images, got 0")
    framing = None
    if settings.framing and settings.spatial and settings.mirrored:
        framing = None if model.whitening is None else model.whitening.framing
        framing = framing or fit_framing(model, images, settings.framing, seed=seed, progress=progress)
    model = model.without_features().with_brightness(None)
    maps, vectors = ([f for f in model.factors if f.mirrored is which] for which in (True, False))
    names = [factor.name for factor in maps]
    gradients = settings.gradients and settings.spatial
    cells = {f.name: HISTOGRAM_CELLS * (gradients and f.parameter == "albedo") for f in maps}
    turns = settings.canonical and settings.spatial and "camera" in {f.parameter for f in vectors}
    turned = {f.name for f in maps if turns and f.parameter == "depth"}

    def activated(batch: Float[Tensor, "n 3 h w"]) -> dict[str, Tensor]:
        batch = batch if framing is None else framing(batch)
        seen = dict.fromkeys(turned, model.frontal(batch)) if turned else {}
        return {n: model.factor_activations(n, seen.get(n, batch), cells[n]) for n in names}

    encode = activated if settings.spatial else model.encode
    mirrored: dict[str, list[Scatter]] = {}
    alone: dict[str, Scatter] = {}
    with evaluating(model):
        for start, batch in batches(model, images, rows, progress):
            scene = model.decompose(batch)
            if settings.photographs and {"albedo", "depth", "light", "camera"} <= scene.parameters.keys():
                shown = photographs(model, scene, batch, generator, settings.views)
            else:
                shown = renderings(model, scene, batch, vectors, perturb, generator, settings.views)
            if framing is not None:
                shown = [batch, *(crop_images(one, _nearly_framed(one, generator)) for one in shown[1:])]
            views = [encode(one) for one in shown]
            if settings.mirrored:
                views += [encode(one.flip(-1)) for one in shown]
            for view in views:  # the images first: of a broken rendering every activation is broken
                own = {f"the activations of {name}": view[name] for name in names}
                _check_finite("whitening", own, start)
            for name in names:
                joined = torch.stack([view[name].float() for view in views])
                blocks = joined.tensor_split([-HISTOGRAMS] if cells[name] else [], dim=-1)
                own = mirrored.setdefault(name, [Scatter() for _ in blocks])
                for scatter, block in zip(own, blocks, strict=True):
                    scatter.add(block)
            exchangeable = len(batch) > 1 and settings.vectors
            for factor in vectors if exchangeable else ():  # maps are exchanged within the batch
                rest = [other for other in model.factors if other.name != factor.name]
                shown = renderings(model, scene, batch, rest, perturb, others, settings.views)
                codes = [model.nets[factor.name].encoder(one).float() for one in shown]
                alone.setdefault(factor.name, Scatter()).add(torch.stack(codes))
    size = size or model.settings.network.code_size
    shrinkage, power = settings.shrinkage, settings.vector_power
    projections = {}
    for name, own in mirrored.items():
        projections[name] = fit_side_by_side(own, settings.directions, shrinkage, size, settings.evenness)
    for name, scatter in alone.items():
        projections[name] = fit_projection(scatter, len(scatter.mean), shrinkage, power=power)
    for name in turned:
        projections[name] = replace(projections[name], map=projections[name].map * TURNED_SHARE**0.5)
    mirrors = mirrored if settings.mirrored else ()
    whitening = Whitening(projections, mirrored=mirrors, canonical=turned, framing=framing)
    return whitening.to(model.device)


@torch.no_grad()
def make_fitting(
    model: Derenderer, images: Shaped[Tensor, "n 3 h w"], settings: FittingSettings, *, seed: int = 0,
    progress: Progress | None = None, maps: MorphableMaps | None = None,
) -> Fitting:  # fmt: skip
    """The morphable model of a model's predicted maps, and the length of features made of fitted scenes.

    Arguments are those of `make_features`, of a model with geometry and albedo. Fewer than two images, and
    maps that are NaN or infinite, are a ValueError.
    """
    rows = torch.randperm(len(images), generator=Generator().manual_seed(seed))[: settings.examples]
    if len(rows) < 2:
        raise ValueError(f"fitting needs at least 2 images, got {len(rows)}")
    model = model.with_features(Features(model.whitening)).with_brightness(None)
    examples: dict[str, list[Tensor]] = {parameter: [] for parameter in PARAMETERS.values()}
    squares = torch.zeros((), dtype=torch.float64)
    with evaluating(model):
        for start, batch in batches(model, images, rows, progress):
            scene, features = model.decompose(batch), model.embed(batch)
            _check_finite("fitting", {name: scene.parameters[name] for name in examples}, start)
            for name, parts in examples.items() if maps is None else ():
                parts.append(scene.parameters[name].float().cpu())
            squares += sum(features[name].double().square().sum().cpu() for name in PARAMETERS)
    if maps is None:
        joined = {name: torch.cat(parts) for name, parts in examples.items()}
        maps = MorphableMaps.of(joined, settings.coordinates)
    fitting = Fitting(maps, settings).to(model.device)
    # squared length of coordinates, all factors together: feed-forward every one varies by 1
    own = float(sum(maps.size(parameter) for parameter in PARAMETERS.values()))
    if settings.steps:
        able = model.with_features(Features(None, fitting))
        total, few = 0.0, rows[:LENGTH_IMAGES]
        for _, batch in batches(model, images, few, None):
            fitted = able.fit_scenes(batch, settings.steps).coordinates
            total += sum(float(value.double().square().sum()) for value in fitted.values())
        own = total / len(few)
    length = (float(squares / len(rows)) / own) ** 0.5 if own else 0.0
    fitting.get_buffer("length").fill_(settings.weight * length)
    return fitting


def _nearly_framed(images: Float[Tensor, "n 3 h w"], generator: Generator) -> Float[Tensor, "n 2 3"]:
    """Random crops that are off by as much as a framing network errs."""
    errors = torch.randn(len(images), 4, generator=generator).clamp(-2, 2) * torch.tensor(FRAMING_ERRORS)
    return similarities(errors).to(images)


def _check_finite(what: str, values: Mapping[str, Tensor], start: int) -> None:
    """NaN or infinity in a batch is an error that names it and its images."""
    for name, value in values.items():
        if not bool(value.isfinite().all()):
            which = f"images {start} to {start + len(value) - 1} of the random subset"
            raise ValueError(f"{what}: NaN or infinity in {name} of {which}: the model's training went wrong")
