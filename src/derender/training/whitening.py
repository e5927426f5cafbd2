"""What other factors do to a trained model's codes, measured on its own renderings.

For geometry and albedo every picture is taken apart, rendered with other values of all its vector factors
(light and camera), and encoded again, several times; mirror images count as views, too, for the object is
symmetric, and, where asked for, the picture itself in other frames, as from a camera that was moved. This is
LOOCC's perturbation, of all vector factors at once, used after training instead of during it. For each vector
factor everything but that factor is changed: maps are another picture's. Leaves out changing one map beside
the other, which brought nothing (docs/log.md).
"""

from collections.abc import Callable, Iterable, Mapping

import torch
from jaxtyping import Float, Shaped
from torch import Generator, Tensor

from derender.data import as_float
from derender.model import Derenderer
from derender.networks import Factor
from derender.postprocess.whitening import Spread, Whitening, contrast
from derender.scene import Scene
from derender.scene.perturb import PerturbSettings
from derender.training.config import WhiteningSettings
from derender.training.step import fill_uncovered

BATCH_SIZE = 128

Describe = Callable[[Float[Tensor, "n 3 h w"]], Mapping[str, Float[Tensor, "n _"]]]
"""Readings by name of pictures in 0..1: the code, then what else there is."""


def fit_whitening(
    model: Derenderer,
    images: Shaped[Tensor, "n 3 h w"],
    settings: WhiteningSettings,
    perturb: PerturbSettings,
    *,
    describe: Describe | None = None,
    size: int | None = None,
    seed: int = 0,
    progress: Callable[[int, int], object] | None = None,
) -> Whitening:
    """The map from what a trained model reads to its features.

    Args:
        model: trained; left as it is.
        images: what it was trained on, uint8 or float in 0..1; as many as the settings say are drawn.
        settings: how many pictures, views and frames, how many directions are kept.
        perturb: how far light and camera are changed.
        describe: whose readings are measured on the model's renderings, all of them; by default the model's
            own of geometry and albedo.
        size: of the features; by default that of the model's code, or of all that ``describe`` says.
        seed: of the draw; the same pictures and renderings whoever describes them.
        progress: called with (pictures done, pictures in all).

    Raises:
        ValueError: fewer than two pictures, or readings that are no numbers.
    """
    generator = torch.Generator().manual_seed(seed)
    chosen = torch.randperm(len(images), generator=generator)[: settings.pictures]
    if not len(chosen):
        raise ValueError("whitening needs at least 2 pictures, got 0")
    own = [factor.name for factor in model.factors if factor.mirrored]
    moving = tuple(factor for factor in model.factors if not factor.mirrored)
    vectors = moving if describe is None and settings.vectors else ()
    others = torch.Generator().manual_seed(seed)  # of their own: what they draw changes no other feature
    found: dict[str, Spread] = {}
    alone: dict[str, Spread] = {}
    model, was_training = model.without_features(), model.training
    model.eval()
    say = describe or (model.activations if settings.spatial else model.encode)
    try:
        with torch.no_grad():
            for start in range(0, len(chosen), BATCH_SIZE):
                rows = chosen[start : start + BATCH_SIZE].to(images.device)
                drawn = images[rows]
                batch = (as_float(drawn) if drawn.dtype == torch.uint8 else drawn.float()).to(model.device)
                scene = model.decompose(batch)
                shown = [batch]
                shown += [
                    _seen_otherwise(model, scene, batch, moving, perturb, generator)
                    for _ in range(settings.views)
                ]
                views = [say(one) for one in shown]
                if settings.mirrored:
                    views += [say(one.flip(-1)) for one in shown]
                names = own if describe is None else tuple(views[0])
                for view in views:  # the pictures first: of a broken rendering every reading is broken
                    broken = [name for name in names if not bool(view[name].isfinite().all())]
                    if broken:
                        raise ValueError(
                            f"whitening: what is read of {broken[0]} is not finite in pictures {start} to "
                            f"{start + len(rows) - 1} of those drawn: the model's training went wrong"
                        )
                for name in names:
                    joined = torch.stack([view[name].float() for view in views])
                    found.setdefault(name, Spread()).add(joined)
                for factor in vectors if len(batch) > 1 else ():  # one alone has nobody to exchange with
                    rest = [other for other in model.factors if other.name != factor.name]
                    shown = [batch]
                    shown += [
                        _seen_otherwise(model, scene, batch, rest, perturb, others)
                        for _ in range(settings.views)
                    ]
                    codes = [model.nets[factor.name].encode(one).float() for one in shown]  # type: ignore[operator]
                    alone.setdefault(factor.name, Spread()).add(torch.stack(codes))
                if progress is not None:
                    progress(min(start + BATCH_SIZE, len(chosen)), len(chosen))
    finally:
        model.train(was_training)
    if describe is None:
        size = size or model.settings.network.code_size
    contrasts = {
        name: contrast(spread, settings.directions, settings.shrinkage, size, settings.evenness)
        for name, spread in found.items()
    }
    contrasts |= {
        name: contrast(spread, len(spread.mean), settings.shrinkage, power=settings.vector_power)
        for name, spread in alone.items()
    }
    return Whitening(contrasts, mirrored=found if settings.mirrored else ()).to(model.device)


@torch.no_grad()
def recentre(
    model: Derenderer,
    images: Shaped[Tensor, "n 3 h w"],
    *,
    progress: Callable[[int, int], object] | None = None,
) -> Whitening:
    """The model's own whitening about the mean of these pictures, uint8 or float in 0..1; the model stays.

    Features of pictures of another kind than those it was fitted to have another mean, on which a penalised
    or hardly trained head leans; nothing else about them changes.

    Raises:
        ValueError: the model's features are not whitened.
    """
    whitening = model.whitening
    if whitening is None:
        raise ValueError("its features are codes, which are not whitened: leave out --mean-only")
    totals: dict[str, Tensor] = {}
    for start in range(0, len(images), BATCH_SIZE):
        drawn = images[start : start + BATCH_SIZE]
        batch = (as_float(drawn) if drawn.dtype == torch.uint8 else drawn.float()).to(model.device)
        for name in whitening.names:
            total = whitening.taken(name, model.factor_activations(name, batch)).double().sum(dim=0)
            totals[name] = totals[name] + total if name in totals else total
        if progress is not None:
            progress(min(start + BATCH_SIZE, len(images)), len(images))
    means = {name: total / len(images) for name, total in totals.items()}
    return whitening.recentred(means).to(model.device)


def _seen_otherwise(
    model: Derenderer,
    scene: Scene,
    pictures: Float[Tensor, "n 3 h w"],
    changing: Iterable[Factor],
    perturb: PerturbSettings,
    generator: Generator,
) -> Float[Tensor, "n 3 h w"]:
    """The scenes rendered with other values of these factors; what nothing covers is filled."""
    changed = {
        factor.parameter: factor.perturb(
            scene.parameters[factor.parameter], generator, perturb, model.settings.ranges
        )
        for factor in changing
        if factor.perturb is not None
    }
    rendering = model.render(scene.with_parameters(**changed))
    return fill_uncovered(rendering.image, rendering.mask, pictures)
