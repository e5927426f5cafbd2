"""Copies of a trained model: whitened, refined by knowledge distillation, or with U-Net encoders."""

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from derender.data import ImageSet, Progress, split_indices
from derender.inputs import as_images, as_model, copy_split
from derender.learn.runs import Changes, OnImages, texts_of
from derender.model import Derenderer
from derender.storage.atomic import new_folder, require_replaceable
from derender.storage.places import model_folder
from derender.training.config import FeatureSettings, with_changes
from derender.training.distillation import RefineConfig
from derender.training.distillation import refine as distil
from derender.training.features import make_features
from derender.training.held_out_errors import read_errors, store_errors, write_errors
from derender.training.unets import UNetSettings, distil_unets

_SETTINGS = {"whiten": FeatureSettings, "refine": RefineConfig, "unet": UNetSettings}


@dataclass(frozen=True)
class ModelCopy:
    """A model made of another one: where it lies, the model, number of images, measurements by name."""

    folder: Path
    model: Derenderer
    images: int
    scores: dict[str, Any] = field(default_factory=dict)

    def values(self) -> dict[str, Any]:
        """Everything as JSON takes it."""
        return {"model": self.folder, "pictures": self.images, **self.scores}


def copy_settings(command: str, settings: Changes = ()) -> Any:
    """All settings of `whiten`, `refine` or `unet` after these changes; an unknown one is a ValueError."""
    return with_changes(_SETTINGS[command](), texts_of(settings))


def whiten(
    model: Derenderer | str | Path, images: ImageSet | str | Path, *, out: str | Path,
    settings: Changes = (), seed: int = 0, **how: Any,
) -> ModelCopy:  # fmt: skip
    """A copy of a model whose features move as little as possible with other factors.

    Whitening, fitting and the brightness prior are estimated on these images, without labels. Weights and
    reconstructions stay as they are. Training ends with this by itself.

    Args:
        model: trained, or where it is.
        images: an image set at the model's size, or its address.
        out: folder of the copy.
        settings: changes of `FeatureSettings`, as ``{"whitening.pictures": 8000}``.
        seed: of the random subset of images and of the renderings.
        how: ``part``, ``dataset``, ``limit``, ``device``, ``overwrite``, ``on_images`` and ``progress``.

    Returns:
        The copy; "between_over_within" has the ratio of each direction by factor.
    """
    features = copy_settings("whiten", settings)
    if features.whitening.pictures < 2:
        raise ValueError("whitening needs 2 images or more: set whitening.pictures=2000")
    work = _Copying(model, images, Path(out), 2, **how)
    made = make_features(work.model, work.pixels, features, seed=seed, progress=work.progress)
    assert made.whitening is not None
    ratios = {name: made.whitening.get_buffer(f"{name}_ratios").tolist() for name in made.whitening.names}
    return work.saved(made, {"between_over_within": ratios}, same_weights=True)


def refine(
    model: Derenderer | str | Path, images: ImageSet | str | Path, *, out: str | Path,
    settings: Changes = (), seed: int = 0, **how: Any,
) -> ModelCopy:  # fmt: skip
    """A copy of a model that predicts at once the scenes that test-time optimisation finds slowly.

    Scenes are fitted to these images once, without labels; then the encoders learn to predict them. Every
    tenth image is held out: errors are measured on those. Arguments are those of `whiten`, for a model with a
    fitting (`whiten` makes one); settings are changes of `RefineConfig`, as ``{"refining.images": 9000}``.

    Returns:
        The copy; "held_out" is the number of held-out images, "errors" and "gaps" are those of `Student`.
    """
    config = copy_settings("refine", settings)
    work = _Copying(model, images, Path(out), 10, **how)
    work.model.features.required_fitting(str(work.model.source or "this model"))
    split = split_indices(work.images.files, (0.9, 0.1, 0.0), seed=seed)
    training, held_out = work.pixels[split.train], work.pixels[split.validation]
    refined = distil(work.model, training, held_out, config, seed=seed, progress=work.progress)
    scores = {"held_out": len(held_out), "errors": refined.errors, "gaps": refined.gaps}
    return replace(work.saved(refined.model, scores, held_out), images=len(split.train))


def unet(
    model: Derenderer | str | Path, images: ImageSet | str | Path, *, out: str | Path,
    settings: Changes = (), seed: int = 0, **how: Any,
) -> ModelCopy:  # fmt: skip
    """A copy of a model with U-Net encoders, which learn its scenes pixel by pixel; for segmentation.

    Arguments are those of `whiten`; settings are changes of `UNetSettings`, as ``{"images": 50_000}``.

    Returns:
        The copy; "errors" are those of `distil_unets`.
    """
    config = copy_settings("unet", settings)
    work = _Copying(model, images, Path(out), 2, **how)
    made = distil_unets(work.model, work.pixels, config, seed=seed, progress=work.progress)
    return work.saved(made.model, {"errors": made.errors})


class _Copying:
    """What every copy of a model needs: the model, the images, and a free place."""

    def __init__(
        self, model: Derenderer | str | Path, images: ImageSet | str | Path, out: Path, at_least: int, *,
        part: str = "all", device: str = "auto", overwrite: bool = False, on_images: OnImages | None = None,
        progress: Progress | None = None, **reading: Any,
    ):  # fmt: skip
        require_replaceable(out, overwrite)
        self.out, self.part, self.overwrite, self.progress = out, part, overwrite, progress
        self.model = as_model(model, device=device)
        self.source = self.model.source if isinstance(model, Derenderer) else model
        reading |= {"part": part, "model": self.source, "at_least": at_least}
        self.images = as_images(images, self.model.image_size, **reading)
        self.pixels = torch.from_numpy(self.images.images)
        if on_images is not None:
            on_images(self.images)

    def saved(
        self, made: Derenderer, scores: dict[str, Any], held_out: Tensor | None = None, *,
        same_weights: bool = False,
    ) -> ModelCopy:  # fmt: skip
        """Save the copy, complete or not at all, with the original's split unless other images were seen.

        Its errors are those of ``held_out`` images; with the ``same_weights`` they are the original's.
        """
        with new_folder(self.out, overwrite=self.overwrite) as folder:
            made.write(folder)
            if held_out is not None:
                store_errors(folder, held_out)
            if self.source is not None and (same_weights or self.part == "train"):
                copy_split(folder, self.source)
                if same_weights and (kept := read_errors(model_folder(self.source))) is not None:
                    write_errors(folder, kept)
        return ModelCopy(self.out, made, len(self.images), scores)
