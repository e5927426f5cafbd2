"""What the commands `train` and `embed` do for baselines: settings by name, one way to make features each."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from derender.cli.console import progress_bar, report_images, result, write_json

if TYPE_CHECKING:
    from derender.data import PictureSet
    from derender.features import FeatureTable
    from derender.settings import Settings
    from derender.training.loop import TrainResult

TRAINED = ("vqvae", "simclr", "ae", "beta-vae", "resnet18", "stylegan2", "e4e", "ris")
CONTROLS = ("pixels", "pca", "hog", "noise")
NAMES = (*TRAINED, "dinov2", "untrained", *CONTROLS)

PANEL = "Baselines"
BaselineName = Annotated[
    str | None,
    typer.Option(
        "--baseline", help=f"Instead of our model: {', '.join(NAMES)}.", metavar="NAME", rich_help_panel=PANEL
    ),
]
BaselineFeatures = Annotated[
    str | None,
    typer.Option(
        "--features",
        help="Which of a baseline's features, with commas between.",
        metavar="A,B",
        rich_help_panel=PANEL,
    ),
]
BaselineCheckpoint = Annotated[
    str | None,
    typer.Option(
        "--checkpoint",
        help="Instead of --model, of e4e: a published file such as e4e_ffhq_encode.pt.",
        metavar="FILE",
        rich_help_panel=PANEL,
    ),
]
BaselineImageSize = Annotated[
    int,
    typer.Option(
        "--image-size",
        min=8,
        help="Side in pixels, for those without a network of a fixed size.",
        metavar="N",
        rich_help_panel=PANEL,
    ),
]
BaselineComponents = Annotated[
    int, typer.Option("--components", min=1, help="Of pca and noise.", metavar="N", rich_help_panel=PANEL)
]
BaselineSeed = Annotated[
    int,
    typer.Option("--seed", min=0, help="Of pca, noise and untrained.", metavar="N", rich_help_panel=PANEL),
]


def baseline_config(
    name: str, overrides: Sequence[str], *, preset: str | None = None, loocc: str | None = None
) -> "Settings":
    """The settings of a baseline's run, with ``key=value`` changes."""
    from derender.baselines.training import CONFIGS, named_baseline
    from derender.training.config import with_changes

    kind = named_baseline(name, CONFIGS)
    for option, value in (("--preset", preset), ("--loocc", loocc)):
        if value is not None:
            raise ValueError(f"{option} is for our own model: leave it out with --model {name}, or use --set")
    return with_changes(kind(), overrides)


def stored_config(run: Path, name: str) -> "Settings":
    """The settings of a run to go on with; ``name`` is derender unless another was asked for."""
    from derender.baselines.training import read_any_config

    config = read_any_config(run)
    if "target" in config.model_dump():
        raise ValueError(f"{run} was made by derender finetune: go on with derender finetune --resume")
    trained = config.model_dump().get("baseline", "derender")
    if name not in ("derender", trained):
        raise ValueError(f"{run} trained {trained}, not {name}: give --model {trained} or another --out")
    return config


def picture_size(config: Any) -> int:
    """The side of the pictures that a run takes, in pixels."""
    from derender.baselines.ris.building import RisConfig
    from derender.baselines.supervised import SupervisedConfig
    from derender.training.config import TrainConfig

    if isinstance(config, SupervisedConfig | RisConfig):
        return config.image_size
    return config.model.network.image_size if isinstance(config, TrainConfig) else config.model.image_size


def train_baseline(
    config: Any, pictures: "PictureSet", out: Path, *, resume: bool, **how: Any
) -> "TrainResult":
    """Train a baseline into a run folder."""
    from derender.baselines.ris.building import RisConfig, ris_run
    from derender.baselines.ris.model import Ris
    from derender.baselines.supervised import SupervisedConfig, supervised_run
    from derender.baselines.training import BaselineTask
    from derender.report.baseline_sheet import baseline_sheet
    from derender.training.loop import train_task

    if isinstance(config, SupervisedConfig | RisConfig):
        if resume:
            raise ValueError(
                f"{config.baseline} trains in minutes and is not resumed: train it again into another --out"
            )
        if isinstance(config, RisConfig):
            return ris_run(config, pictures, out, sample_sheet=baseline_sheet(Ris.shown), **how)
        return supervised_run(config, pictures, out, **how)
    task = BaselineTask(config)
    return train_task(task, pictures, out, resume=resume, sample_sheet=baseline_sheet(task.shown), **how)


def open_baseline(
    name: str,
    model: str | None,
    *,
    device: str,
    features: str | None,
    image_size: int,
    seed: int,
    checkpoint: str | None = None,
) -> Any:
    """A network that embeds; ``model`` is its run folder (dinov2: an id or a folder; untrained: ours)."""
    from derender.baselines.controls import untrained_twin
    from derender.baselines.training import load_baseline
    from derender.cli.models import chosen_device, open_model

    if checkpoint is not None and (name != "e4e" or model is not None):
        raise ValueError("--checkpoint is a published e4e file: give it with --baseline e4e and no --model")
    if name == "untrained":
        return untrained_twin(open_model(_needed(name, model), device), seed)
    if name == "dinov2":
        from derender.baselines.dinov2 import DEFAULT_ID, load_dinov2

        net = load_dinov2(model or DEFAULT_ID, image_size=image_size)
    elif checkpoint is not None:
        from derender.baselines.stylegan2.published import load_published_e4e

        net = load_published_e4e(checkpoint)
    else:
        net = load_baseline(_needed(name, model), name)
    if features is not None:
        net.choose(tuple(part.strip() for part in features.split(",")))
    return net.to(chosen_device(device))


def write_control(
    name: str,
    data: str,
    out: Path,
    *,
    dataset: str,
    part: str,
    limit: int | None,
    model: str | None,
    image_size: int,
    components: int,
    seed: int,
    json_file: str | None,
) -> None:
    """Write the table of a control; PCA is fitted on the training part where ``part`` is not all."""
    from derender.cli.models import part_of
    from derender.data import read_pictures

    with progress_bar("reading") as report:
        pictures = read_pictures(data, image_size, dataset=dataset, limit=limit, progress=report)
    chosen = part_of(pictures, part, model)
    fit_on = pictures if part == "all" else part_of(pictures, "train", model)
    report_images(chosen)
    with progress_bar("describing") as report:
        table = control_features(name, chosen, fit_on, components=components, seed=seed, progress=report)
    table.write(out)
    sizes = {factor: values.shape[1] for factor, values in table.factors.items()}
    told = ", ".join(f"{factor} {size}" for factor, size in sizes.items())
    result(f"{len(table):,} rows in {out}: {told}", json_file)
    values = {"out": out, "rows": len(table), "factors": sizes, "labels": list(table.labels)}
    write_json(json_file, {**values, "origin": table.origin})


def control_features(
    name: str, pictures: "PictureSet", fit_on: "PictureSet", *, components: int, seed: int, progress: Any
) -> "FeatureTable":
    """The table of a control that has no network; PCA is fitted on ``fit_on``."""
    from derender.baselines.controls import noise_features, pca_features, pixel_features
    from derender.baselines.hog import hog_features

    if name == "pixels":
        return pixel_features(pictures)
    if name == "pca":
        return pca_features(pictures, components=components, fit_on=fit_on, seed=seed)
    if name == "hog":
        return hog_features(pictures, progress=progress)
    return noise_features(pictures, dimensions=components, seed=seed)


def checked(name: str) -> str:
    """The name if there is such a baseline, else an error that names the nearest one."""
    from derender.data import suggestion

    if name not in NAMES:
        raise ValueError(f"no baseline {name!r}{suggestion(name, NAMES)}: choose one of {', '.join(NAMES)}")
    return name


def _needed(name: str, model: str | None) -> str:
    if model is None:
        what = "our model whose networks it copies" if name == "untrained" else "its run folder"
        raise ValueError(f"--baseline {name} needs --model: {what}")
    return model
