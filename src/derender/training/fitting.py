"""What a trained model needs to fit scenes to pictures: a morphable model of its own answers.

Leaves out the fitting itself (postprocess/fitting.py), which happens when a model is used.
"""

from collections.abc import Callable

import torch
from jaxtyping import Float, Shaped
from torch import Tensor

from derender.data import as_float
from derender.model import Derenderer
from derender.postprocess import Features
from derender.postprocess.fitting import PARAMETERS, Fitting, FittingSettings
from derender.postprocess.morphable import MorphableMaps

BATCH_SIZE = 128
MEASURED = 256  # pictures that are fitted to learn how long fitted coordinates are, where features hold them


def make_fitting(
    model: Derenderer,
    images: Shaped[Tensor, "n 3 h w"],
    settings: FittingSettings,
    *,
    seed: int = 0,
    progress: Callable[[int, int], object] | None = None,
    maps: MorphableMaps | None = None,
) -> Fitting:
    """The morphable model of what a model says of pictures, and the length of features made of fitted scenes.

    Args:
        model: trained and, if it is to be, whitened; left as it is.
        images: what it was trained on, uint8 or float in 0..1; as many as the settings say are drawn.
        settings: how many examples and coordinates, and how scenes are fitted later.
        seed: of the draw.
        progress: called with (pictures done, pictures in all).
        maps: a morphable model that is there already; by default one is made.

    Raises:
        ValueError: fewer than two pictures, maps that are no numbers, or a model without geometry and albedo.
    """
    names = {factor.name for factor in model.factors}
    missing = sorted(set(PARAMETERS) - names)
    if missing:
        raise ValueError(f"fitting needs the factors {', '.join(PARAMETERS)}; this model has no {missing[0]}")
    generator = torch.Generator().manual_seed(seed)
    chosen = torch.randperm(len(images), generator=generator)[: settings.examples]
    if len(chosen) < 2:
        raise ValueError(f"fitting needs at least 2 pictures, got {len(chosen)}")
    found: dict[str, list[Tensor]] = {parameter: [] for parameter in PARAMETERS.values()}
    squares = torch.zeros((), dtype=torch.float64)
    model, was_training = model.with_features(Features(model.whitening)), model.training
    model.eval()
    try:
        with torch.no_grad():
            for start in range(0, len(chosen), BATCH_SIZE):
                batch = _pictures(images[chosen[start : start + BATCH_SIZE].to(images.device)], model)
                scene, features = model.decompose(batch), model.embed(batch)
                for parameter, kept in found.items():
                    said = scene.parameters[parameter].float().cpu()
                    if not bool(said.isfinite().all()):
                        raise ValueError(
                            f"fitting: {parameter} is not finite in pictures {start} to "
                            f"{start + len(batch) - 1} of those drawn: the model's training went wrong"
                        )
                    if maps is None:
                        kept.append(said)
                squares += sum(features[name].double().square().sum().cpu() for name in PARAMETERS)
                if progress is not None:
                    progress(min(start + BATCH_SIZE, len(chosen)), len(chosen))
    finally:
        model.train(was_training)
    if maps is None:
        examples = {name: torch.cat(parts) for name, parts in found.items()}
        maps = MorphableMaps.of(examples, settings.coordinates)
    fitting = Fitting(maps, settings).to(model.device)
    said = float(squares / len(chosen))
    if settings.steps:
        own = _mean_square(model, fitting, images[chosen[:MEASURED].to(images.device)])
    else:  # as read every coordinate varies by 1
        own = float(sum(maps.size(parameter) for parameter in PARAMETERS.values()))
    fitting.get_buffer("length").fill_(settings.weight * (said / own) ** 0.5 if own else 0.0)
    return fitting


def _mean_square(model: Derenderer, fitting: Fitting, images: Shaped[Tensor, "n 3 h w"]) -> float:
    """Squared length of the pictures' fitted coordinates, all factors together, the mean over pictures."""
    total = 0.0
    for start in range(0, len(images), BATCH_SIZE):
        batch = _pictures(images[start : start + BATCH_SIZE], model)
        with torch.no_grad():
            scene = model.decompose(batch)
        fitted = fitting.fit(batch, scene, model.render, fitting.settings.steps)
        total += sum(float(value.double().square().sum()) for value in fitted.coordinates.values())
    return total / len(images)


def _pictures(images: Shaped[Tensor, "n 3 h w"], model: Derenderer) -> Float[Tensor, "n 3 h w"]:
    return (as_float(images) if images.dtype == torch.uint8 else images.float()).to(model.device)
