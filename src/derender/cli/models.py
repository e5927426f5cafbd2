"""Opening a model, and the part of a data set that it did or did not see in training."""

from pathlib import Path
from typing import TYPE_CHECKING

from derender.cli.console import notice, progress_bar, report_images

if TYPE_CHECKING:
    from derender.data import PictureSet
    from derender.evaluation.fitted import FittedModel
    from derender.features import FeatureTable
    from derender.model import Derenderer
    from derender.postprocess.fitting import Fitting
    from derender.storage.split import SplitRecord

PARTS = ("all", "train", "validation", "test")


def open_model(source: str, device: str, fit_steps: int | None = None) -> "Derenderer":
    """Load a model onto a device named as in ``chosen_device``; weights that are no numbers are an error.

    With ``fit_steps`` its features are made of scenes fitted in so many steps (0: of none).
    """
    from derender.model import load

    model = load(source, device=chosen_device(device))
    for name, value in model.state_dict().items():
        if value.is_floating_point() and not bool(value.isfinite().all()):
            raise ValueError(
                f"{source} has weights that are no numbers (first {name}): its training went wrong or the "
                "file is damaged; take another checkpoint or train again"
            )
    if fit_steps is not None and (fit_steps or model.fitting is not None):
        fitting_of(model, source).set_steps(fit_steps)
    return model


def with_fitted_scenes(model: "Derenderer", source: str, steps: int | None) -> "Derenderer | FittedModel":
    """The model, or with steps one whose scenes are fitted in so many."""
    from derender.evaluation.fitted import FittedModel

    if not steps:
        return model
    fitting_of(model, source)
    return FittedModel(model, steps)


def check_maker(model: "Derenderer", source: str, table: "FeatureTable", path: str | Path) -> None:
    """Bring a model to as many steps of fitting as a table was made with; another model's is an error."""
    from derender.features import model_fingerprint

    if model.fitting is not None and isinstance(steps := table.origin.get("fit_steps"), int):
        model.fitting.set_steps(max(0, steps))
    made_by, weights = table.origin.get("weights"), model_fingerprint(model)
    if made_by is None:
        notice(f"{path} does not say which model made it: cannot check that it was {source}")
    elif made_by != weights:
        raise ValueError(
            f"{path} was made by another model (weights {made_by}, {source} has {weights}): "
            "give that one, or make the table again with derender embed"
        )


def fitting_of(model: "Derenderer", source: str) -> "Fitting":
    """What a model fits scenes with, or an error that says how to make it."""
    if model.fitting is None:
        raise ValueError(
            f"{source} cannot fit scenes yet: derender whiten --model {source} --data PICTURES --out NEW "
            "makes a copy that can"
        )
    return model.fitting


def chosen_device(device: str) -> str:
    """``cpu`` or ``cuda``; for ``auto`` the graphics card if there is one."""
    import torch

    if device not in ("auto", "cpu", "cuda"):
        raise ValueError(f"unknown device {device!r}: choose auto, cpu or cuda")
    if device == "cuda" and not torch.cuda.is_available():
        raise ValueError("no CUDA device here: choose --device cpu")
    return "cuda" if device != "cpu" and torch.cuda.is_available() else "cpu"


def pictures_for(
    net: "Derenderer", model: str, data: str, *, dataset: str, part: str, limit: int | None, fewest: int
) -> "PictureSet":
    """A data set's pictures at a model's size, of one part of its split; says what they are."""
    from derender.data import read_pictures

    with progress_bar("reading") as report:
        pictures = read_pictures(data, net.image_size, dataset=dataset, limit=limit, progress=report)
    chosen = part_of(pictures, part, model).require(fewest)
    report_images(chosen)
    return chosen


def part_of(pictures: "PictureSet", part: str, model: str | None) -> "PictureSet":
    """The pictures of one part of the split of ``model``: a run, or a model that was saved from one."""
    if part not in PARTS:
        raise ValueError(f"unknown part {part!r}: choose {', '.join(PARTS)}")
    if part == "all":
        return pictures
    from derender.data import split_indices

    if model is None:
        raise ValueError("--part needs --model: the run whose split it is")
    record = split_of(model)
    if record is None:
        raise ValueError(f"{model} is no run folder and records no split: use --part all")
    split = split_indices(pictures.files, record.shares, seed=record.seed)
    return pictures.select(getattr(split, part)).require(1, f"the {part} part")


def split_of(model: str) -> "SplitRecord | None":
    """The split of a run, or of the run that a saved model comes from; None where nothing says it."""
    from derender.baselines.training import read_any_config
    from derender.storage.folder import model_folder
    from derender.storage.split import SplitRecord, read_split

    if (Path(model) / "config.yaml").is_file():
        config = read_any_config(Path(model))
        return SplitRecord(config.split, config.seed)
    try:
        return read_split(model_folder(model))
    except FileNotFoundError:
        return None


def keep_split(folder: Path, model: str) -> None:
    """Keep with a copy of ``model`` the split of its training, if that is known."""
    from derender.storage.split import write_split

    record = split_of(model)
    if record is not None:
        write_split(folder, record)
