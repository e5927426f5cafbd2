"""What makes features of a trained model: whitening, then what fits scenes to pictures."""

from collections.abc import Callable

from jaxtyping import Shaped
from torch import Tensor

from derender.model import Derenderer
from derender.postprocess import Features
from derender.postprocess.fitting import PARAMETERS
from derender.postprocess.morphable import MorphableMaps
from derender.training.config import FeatureSettings
from derender.training.fitting import make_fitting
from derender.training.whitening import fit_whitening


def make_features(
    model: Derenderer,
    images: Shaped[Tensor, "n 3 h w"],
    settings: FeatureSettings,
    *,
    seed: int = 0,
    progress: Callable[[int, int], object] | None = None,
    maps: MorphableMaps | None = None,
) -> Derenderer:
    """A model that shares these weights, with whitening and fitting as far as the settings ask for them.

    A feature keeps the size of the code: where fitted coordinates are part of it, what is read has the rest.

    Args:
        model: trained.
        images: what it was trained on, uint8 or float in 0..1.
        settings: how.
        seed: of the pictures that are drawn.
        progress: called with (pictures done, pictures in all), once for each of the two.
        maps: to fit scenes within, by default made of what the model says.

    Raises:
        ValueError: too few pictures, or more fitted coordinates than a feature has numbers.
    """
    size = model.settings.network.code_size
    model = model.with_features(Features(model.whitening))
    if settings.fitting.steps:
        size -= settings.fitting.coordinates
        if size < 1:
            raise ValueError(
                f"{settings.fitting.coordinates} fitted coordinates leave none of a feature's "
                f"{model.settings.network.code_size} numbers to what is read: set coordinates lower"
            )
    if settings.whitening.pictures >= 2:
        whitening = fit_whitening(
            model, images, settings.whitening, settings.perturb, size=size, seed=seed, progress=progress
        )
        model = model.with_features(Features(whitening))
    if settings.fitting.examples >= 2 and PARAMETERS.keys() <= {factor.name for factor in model.factors}:
        fitting = make_fitting(model, images, settings.fitting, seed=seed, progress=progress, maps=maps)
        model = model.with_features(Features(model.whitening, fitting))
    return model
