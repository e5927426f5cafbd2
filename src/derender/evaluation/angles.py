"""Angles that a model predicts against known ones: of the head (``pose``) and of the light (``light``).

Known angles are labels of the images or a table, such as another judge's. Correlation and slope ask whether
angles move together. The error is what remains after the mean difference: which way an average face looks is
a convention. Beside the model stand the best constant answer and the same networks untrained.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from posixpath import basename
from typing import Any
from zipfile import BadZipFile

import numpy as np
import torch
from torch import Tensor

from derender.baselines.controls import untrained_twin
from derender.data import ImageSet
from derender.data.layouts import rendered
from derender.evaluation.bootstrap import Estimate, ScoredRow, estimate, numbers_of
from derender.evaluation.image_scores import binned_rows
from derender.evaluation.options import Options
from derender.evaluation.scenes import optimised
from derender.evaluation.score_table import Column, Scores, ScoreTable, scored_table
from derender.evaluation.truth import angle_deg, light_in_camera
from derender.features import map_batches, named
from derender.inputs import as_model
from derender.model import Derenderer
from derender.storage.bounded import LINES_LIMIT_BYTES, first_line, require_regular

AGREEMENT = {
    "r": Column("r", "high", note="Pearson's correlation, -1 to 1"),
    "slope": Column("slope", None, note="of the regression of predicted on true, best 1"),
    "error": Column("error", "low", 2, "mean absolute difference after the mean difference, best 0"),
    "offset": Column("offset", None, 2, "mean difference, predicted less true"),
}
POSE = {"yaw": "camera_y_rad", "pitch": "camera_x_rad", "roll": "camera_z_rad"}
LIGHT = {"azimuth": "light_azimuth_deg", "elevation": "light_elevation_deg"}


def agreement(predicted: np.ndarray, true: np.ndarray, weights: np.ndarray) -> dict[str, Estimate]:
    """The scores of ``AGREEMENT`` of (N,) numbers, with intervals; weights are by ``once_and_resampled``."""
    x, y, apart = predicted - predicted.mean(), true - true.mean(), predicted - true
    of_each = (x, y, x * y, x * x, y * y, apart, np.abs(apart - apart.mean()))
    mx, my, xy, xx, yy, offset, error = (weights @ one / weights.sum(axis=1) for one in of_each)
    with np.errstate(invalid="ignore", divide="ignore"):  # a constant has no correlation: NaN
        covariance, spread, true_spread = xy - mx * my, xx - mx * mx, yy - my * my
        r = np.where(spread > 1e-12, covariance / np.sqrt(spread * true_spread), np.nan)
        scores = (r, covariance / true_spread, error, offset)
    return {name: estimate(own[:1], own[1:]) for name, own in zip(AGREEMENT, scores, strict=True)}


def agreement_table(
    caption: str, predicted: Mapping[str, np.ndarray], true: np.ndarray, weights: np.ndarray, digits: int = 2
) -> tuple[ScoreTable, dict[str, Any]]:
    """A row for each name, all but the first controls, then the constant answer; and the numbers for JSON."""
    answers = {**predicted, "constant answer": np.full(len(true), true.mean())}
    scores = {name: agreement(np.asarray(own, np.float64), true, weights) for name, own in answers.items()}
    rows = [ScoredRow(name, at > 0, 1, own) for at, (name, own) in enumerate(scores.items())]
    columns = {name: replace(one, digits=digits if one.digits == 2 else 3) for name, one in AGREEMENT.items()}
    every: dict[str, Any] = {"intervals": ("r", "slope", "error"), "deviations": ()}
    return scored_table(caption, "prediction", rows, columns, **every), numbers_of(rows)


def pose(
    model: Derenderer | str | Path, images: ImageSet | str | Path, table: str | Path | None = None, *,
    fit_steps: int | None = None, **options: Any,
) -> Scores:  # fmt: skip
    """Yaw, pitch and roll of the head against known angles in degrees: r and slope best 1, error best 0.

    Args:
        model: a model, or the name or folder of one.
        images: an image set at the model's size, or the address of a data set.
        table: ``.npz``, ``.csv`` or ``.parquet`` with ``name`` (or ``file``), ``yaw``, ``pitch`` and ``roll``
            in degrees, signs as of ``Scene.camera``. Images that it does not name are left out. None takes
            the labels of a rendered set.
        fit_steps: steps of per-image optimisation of the model's scenes.
        options: seed, resamples, dataset, limit, device, progress: fields of ``Options``.

    Raises:
        ValueError: neither labels nor a table hold the angles, or the table names none of the images.
    """
    return _angles("Pose", model, images, table, fit_steps, options)


def light(
    model: Derenderer | str | Path, images: ImageSet | str | Path, table: str | Path | None = None, *,
    fit_steps: int | None = None, **options: Any,
) -> Scores:  # fmt: skip
    """Azimuth and elevation of the light in the camera's frame, in degrees, against known ones.

    Positive azimuth lights the left of the image, positive elevation comes from above. A further table has
    the angle between both directions, by the angle between light and view. Arguments are those of ``pose``;
    a table has the columns ``azimuth`` and ``elevation``.
    """
    return _angles("Light", model, images, table, fit_steps, options)


def _angles(
    what: str, model: Any, images: Any, table: Any, fit_steps: int | None, options: Mapping[str, Any]
) -> Scores:
    labels = POSE if what == "Pose" else LIGHT
    how = Options.of(options, images=images, keep_duplicates=True)
    model = as_model(model, device=how.device)
    true, read = known_angles(how.at(model.image_size), table, labels)
    nets = {"model": optimised(model, fit_steps), "untrained model": untrained_twin(model, how.seed)}

    def see(net: Any, batch: Tensor) -> np.ndarray:
        scene = net.decompose(batch)
        pose = torch.rad2deg(scene.camera[:, [1, 0, 2]])
        angles = pose if what == "Pose" else _spherical(light_in_camera(scene.light, scene.camera))
        return angles.double().numpy(force=True)

    results = {}
    for name, net in nets.items():
        parts = map_batches(partial(see, net), net, read.images, batch_size=64, progress=how.stage(name))
        results[name] = np.concatenate(parts)
    weights = how.drawn(read.labels.get("identity", np.array(read.files)).astype(str))
    tables: list[ScoreTable] = []
    values: dict[str, Any] = {"pictures": len(read)}
    for column, name in enumerate(labels):
        answers = {row: angles[:, column] for row, angles in results.items()}
        caption = f"{what}: {name} in degrees, {len(read):,} images"
        shown, values[name] = agreement_table(caption, answers, true[:, column], weights)
        tables.append(shown)
    if what == "Light":
        aim = _unit(true)
        aimed = {name: _unit(angles) for name, angles in results.items()}
        aimed["constant answer"] = np.broadcast_to(aim.mean(axis=0), aim.shape)
        apart = {name: angle_deg(torch.tensor(own), torch.tensor(aim)).numpy() for name, own in aimed.items()}
        off = np.degrees(np.arccos(np.clip(aim[:, 2], -1, 1))).round(3)
        rows, columns, _ = binned_rows(apart, off, weights, best="low", digits=1)
        caption = "Light: degrees between true and predicted direction, by the angle between light and view"
        tables.append(scored_table(caption, "prediction", rows, columns, deviations=()))
        values["direction"] = numbers_of(rows)
    return Scores(tables, values, how.notes)


def known_angles(
    images: ImageSet, table: str | Path | None, labels: Mapping[str, str]
) -> tuple[np.ndarray, ImageSet]:
    """(N, angles) in degrees by the names of ``labels``, and the images that have them all."""
    if table is not None:
        columns = read_columns(table, tuple(labels))
        place = {basename(name): row for row, name in enumerate(columns["name"].tolist())}
        rows = np.array([place.get(basename(file), -1) for file in images.files])
        if not (rows >= 0).any():
            raise ValueError(f"{table} names none of the images (its first is {columns['name'][0]})")
        true = np.stack([columns[name].astype(np.float64)[rows] for name in labels], axis=1)
        true[rows < 0] = np.nan
    elif set(labels.values()) <= set(images.labels):
        true = np.stack([images.labels[name].astype(np.float64) for name in labels.values()], axis=1)
        true = np.degrees(true) if next(iter(labels.values())).endswith("_rad") else true
    elif labels is LIGHT and {*rendered.LIGHT, *POSE.values()} <= set(images.labels):
        asked = rendered.LIGHT, rendered.CAMERA[:3]
        stacked = (np.stack([images.labels[name] for name in names], axis=1) for names in asked)
        given, turned = (torch.from_numpy(one.astype(np.float32)) for one in stacked)
        true = _spherical(light_in_camera(given, torch.nn.functional.pad(turned, (0, 3)))).numpy()
    else:
        what, have = ", ".join(labels.values()), ", ".join(images.labels) or "none"
        how = f"give a table with name, {', '.join(labels)}"
        raise ValueError(f"{images.source} has no labels {what} (it has {have}): {how}")
    known = np.flatnonzero(np.isfinite(true).all(axis=1))
    if len(known) < 2:
        raise ValueError(f"{len(known)} images have known angles: two or more are needed")
    return true[known], images.select(known)


def read_columns(path: str | Path, names: Sequence[str]) -> dict[str, np.ndarray]:
    """Columns of a ``.npz``, ``.csv`` or ``.parquet`` table, and ``name``: its column name or file."""
    import pyarrow.csv as csv
    import pyarrow.parquet as parquet

    try:
        require_regular(Path(path), LINES_LIMIT_BYTES)
        if Path(path).suffix == ".npz":
            with np.load(path, allow_pickle=False) as stored:
                if sum(one.file_size for one in stored.zip.infolist()) > LINES_LIMIT_BYTES:
                    raise ValueError(f"it unpacks to more than {LINES_LIMIT_BYTES >> 20} MiB")
                kept = {name: stored[name] for name in stored.files if name in (*names, "name", "file")}
        else:
            table = csv.read_csv(path) if Path(path).suffix == ".csv" else parquet.read_table(path)
            kept = {name: table[name].to_numpy() for name in table.column_names}
    except (OSError, ValueError, EOFError, MemoryError, BadZipFile) as problem:
        why = first_line(problem)
        raise ValueError(f"{path} cannot be read as .npz, .csv or .parquet: {why}") from problem
    kept = kept if "name" in kept or "file" not in kept else {**kept, "name": kept["file"]}
    return {name: named(kept, name, f"column of {path}") for name in ("name", *names)}


def _spherical(direction: Tensor) -> Tensor:
    """Azimuth and elevation in degrees, (N, 2), of unit directions in which light travels."""
    x, y, z = direction.unbind(-1)
    return torch.rad2deg(torch.stack((torch.atan2(x, z), torch.asin(y.clamp(-1, 1))), dim=-1))


def _unit(angles: np.ndarray) -> np.ndarray:
    """The inverse of ``_spherical``, (N, 3)."""
    azimuth, elevation = np.radians(angles.astype(np.float64)).T
    flat = np.cos(elevation)
    return np.stack((np.sin(azimuth) * flat, np.sin(elevation), np.cos(azimuth) * flat), axis=1)
