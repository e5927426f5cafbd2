"""Arguments of library calls: a model or its name, images or the address of a data set, a device by name.

Every documented call resolves either form here: commands and Python users get the same checks and errors.
"""

from pathlib import Path
from typing import Any

import torch

from derender.data import ImageSet, Progress, read_images, split_indices
from derender.model import Derenderer, load
from derender.overrides import checked
from derender.storage.folder import SplitRecord, read_split, write_split
from derender.storage.places import DEVICES, model_folder, require_known
from derender.training.config import LoopSettings
from derender.training.run_folder import read_config_tree

PARTS = ("all", "train", "validation", "test")


def as_model(
    model: Derenderer | str | Path, *, device: str = "auto", fit_steps: int | None = None
) -> Derenderer:
    """A model ready for use: one that is loaded already is returned as it is, a name is loaded.

    Args:
        model: a model, a run folder, a saved folder, a bundled name or a Hugging Face Hub id.
        device: "auto", "cpu" or "cuda", for a model that is loaded here.
        fit_steps: Adam steps of test-time optimisation for its features; 0 makes none, None keeps its own.

    Raises:
        FileNotFoundError: no model is there.
        ValueError: the model is damaged, has weights that are not finite, or cannot be optimised per image.
    """
    if isinstance(model, Derenderer):
        source, loaded = str(model.source or "this model"), model
    else:
        source, loaded = str(model), load(model, device=device_named(device))
        for name, value in loaded.state_dict().items():
            if value.is_floating_point() and not bool(value.isfinite().all()):
                what = f"{source} has weights that are NaN or infinite (first {name})"
                why = "its training went wrong or the file is damaged"
                raise ValueError(f"{what}: {why}; take another checkpoint or train again")
    if fit_steps is not None and (fit_steps or loaded.fitting is not None):
        loaded.features.required_fitting(source)
        loaded = loaded.with_features(loaded.features.with_steps(fit_steps))
    return loaded


def as_images(
    images: ImageSet | str | Path, image_size: int, *, dataset: str = "auto", limit: int | None = None,
    part: str = "all", model: str | Path | SplitRecord | None = None, at_least: int = 1,
    keep_duplicates: bool = False, progress: Progress | None = None,
) -> ImageSet:  # fmt: skip
    """Decoded images: a set that is read already is returned as it is, an address is read.

    Args:
        images: a set, or a folder, zip, ``PATH::SUBSET``, shards or Hugging Face id.
        image_size: side in pixels to read at.
        dataset: the layout's name, or "auto".
        limit: at most so many images, evenly spaced in the sorted list.
        part, model: "all", or the "train", "validation" or "test" part of a split, or of a model's.
        at_least, keep_duplicates: fewer images raise an error; keep every one of identical images.
        progress: called with (done, total) while reading.
    """
    if not isinstance(images, ImageSet):
        how: dict[str, Any] = {"dataset": dataset, "limit": limit, "keep_duplicates": keep_duplicates}
        images = read_images(images, image_size, **how, progress=progress)
    return part_of(images, part, model).require(at_least)


def part_of(images: ImageSet, part: str, model: str | Path | SplitRecord | None) -> ImageSet:
    """The images of one part of a split, or of that of a run or of a model that was saved from one."""
    require_known("part", part, PARTS)
    if part == "all":
        return images
    if model is None:
        raise ValueError(f"part {part!r} needs a model: the run whose split it is")
    record = model if isinstance(model, SplitRecord) else split_of(model)
    if record is None:
        raise ValueError(f"{model} is no run folder and records no split: use part all")
    split = split_indices(images.files, record.shares, seed=record.seed)
    return images.select(getattr(split, part)).require(1, f"the {part} part")


def split_of(model: str | Path) -> SplitRecord | None:
    """The split of a run, or of the run that a saved model comes from; None where it is not recorded."""
    if (Path(model) / "config.yaml").is_file():
        recorded = read_config_tree(Path(model))
        own = checked({key: recorded[key] for key in ("split", "seed") if key in recorded}, LoopSettings)
        return SplitRecord(own.split, own.seed)
    try:
        return read_split(model_folder(model))
    except FileNotFoundError:
        return None


def copy_split(folder: Path, model: str | Path) -> None:
    """Record with a copy of ``model`` the split of its training, if that is known."""
    if (record := split_of(model)) is not None:
        write_split(folder, record)


def device_named(device: str) -> str:
    """``cpu`` or ``cuda``; for ``auto`` the graphics card if there is one."""
    require_known("device", device, DEVICES)
    if device == "cuda" and not torch.cuda.is_available():
        raise ValueError("no CUDA device here: choose device cpu")
    return "cuda" if device != "cpu" and torch.cuda.is_available() else "cpu"
