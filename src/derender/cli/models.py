"""Opening a model, and the part of a data set that it did or did not see in training."""

from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from derender.data import PictureSet
    from derender.model import Derenderer

PARTS = ("all", "train", "validation", "test")


def open_model(source: str, device: str) -> "Derenderer":
    """Load a model onto a device named as in ``chosen_device``; weights that are no numbers are an error."""
    from derender.model import load

    model = load(source, device=chosen_device(device))
    for name, value in model.state_dict().items():
        if value.is_floating_point() and not bool(value.isfinite().all()):
            raise ValueError(
                f"{source} has weights that are no numbers (first {name}): its training went wrong or the "
                "file is damaged; take another checkpoint or train again"
            )
    return model


def chosen_device(device: str) -> str:
    """``cpu`` or ``cuda``; for ``auto`` the graphics card if there is one."""
    import torch

    if device not in ("auto", "cpu", "cuda"):
        raise ValueError(f"unknown device {device!r}: choose auto, cpu or cuda")
    if device == "cuda" and not torch.cuda.is_available():
        raise ValueError("no CUDA device here: choose --device cpu")
    return "cuda" if device != "cpu" and torch.cuda.is_available() else "cpu"


def part_of(pictures: "PictureSet", part: str, model: str | None) -> "PictureSet":
    """The pictures of one part of the split that the run ``model`` was trained with."""
    if part not in PARTS:
        raise ValueError(f"unknown part {part!r}: choose {', '.join(PARTS)}")
    if part == "all":
        return pictures
    from derender.baselines.training import read_any_config
    from derender.data import split_indices

    if model is None:
        raise ValueError("--part needs --model: the run whose split it is")
    if not (Path(model) / "config.yaml").is_file():
        raise ValueError(f"{model} is no run folder and records no split: use --part all")
    config = read_any_config(Path(model))
    split = split_indices(pictures.files, config.split, seed=config.seed)
    return pictures.select(getattr(split, part)).require(1, f"the {part} part")
