"""Models as commands name them; what library calls take as well is in derender.inputs."""

from pathlib import Path
from typing import TYPE_CHECKING

from derender.cli.console import notice, progress_bar, report_images
from derender.inputs import as_images, as_model, copy_split, device_named, part_of, split_of

if TYPE_CHECKING:
    from derender.data import PictureSet
    from derender.features import FeatureTable
    from derender.model import Derenderer
    from derender.postprocess.fitting import Fitting

keep_split, chosen_device = copy_split, device_named
__all__ = ["chosen_device", "keep_split", "part_of", "split_of"]


def open_model(source: str, device: str, fit_steps: int | None = None) -> "Derenderer":
    """See `derender.inputs.as_model`."""
    return as_model(source, device=device, fit_steps=fit_steps)


def check_maker(model: "Derenderer", source: str, table: "FeatureTable", path: str | Path) -> "Derenderer":
    """The model with the fitting steps a table was made with; a table of another model is an error."""
    from derender.features import model_fingerprint

    if model.fitting is not None and isinstance(steps := table.origin.get("fit_steps"), int):
        model = model.with_features(model.features.with_steps(max(0, steps)))
    made_by, weights = table.origin.get("weights"), model_fingerprint(model)
    if made_by is None:
        notice(f"{path} does not record which model made it: cannot check that it was {source}")
    elif made_by != weights:
        raise ValueError(
            f"{path} was made by another model (weights {made_by}, {source} has {weights}): "
            "give that one, or make the table again with derender embed"
        )
    return model


def fitting_of(model: "Derenderer", source: str) -> "Fitting":
    """The maps and settings of a model's test-time optimisation, or an error that names how to get them."""
    return model.features.required_fitting(source)


def pictures_for(
    net: "Derenderer", model: str, data: str, *, dataset: str, part: str, limit: int | None, fewest: int
) -> "PictureSet":
    """A data set's images at a model's size, of one part of its split; reports what they are."""
    with progress_bar("reading") as report:
        images = as_images(
            data, net.image_size, dataset=dataset, limit=limit, part=part, model=model, at_least=fewest,
            progress=report,
        )  # fmt: skip
    report_images(images)
    return images
