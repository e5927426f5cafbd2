"""Protocols of decomposed scenes: are geometry, albedo, light and camera the true ones, and the images alike?

Every score is beside constant answers and the same networks untrained. With ``fit_steps`` the model's scenes,
not the untrained one's, are optimised against their images first.
"""

from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from torch import Tensor

from derender.baselines.controls import untrained_twin
from derender.data import GroundTruth, ImageSet, read_ground_truth
from derender.evaluation.bootstrap import RESAMPLES
from derender.evaluation.depth import GEOMETRY, GeometryResult, evaluate_geometry
from derender.evaluation.factors import FACTORS, FactorResult, evaluate_factors
from derender.evaluation.image_scores import image_verdicts
from derender.evaluation.memory import Memory
from derender.evaluation.pixels import (
    RECONSTRUCTION,
    ReconstructionResult,
    evaluate_reconstruction,
    mean_picture,
)
from derender.evaluation.score_table import Scores
from derender.features import Progress, model_fingerprint
from derender.inputs import as_images, as_model, require_fitting
from derender.model import Derenderer
from derender.render import Rendering
from derender.scene import Scene

COMPONENT_IMAGES = 2_000


def geometry(
    model: Derenderer | str | Path,
    truth: GroundTruth | str | Path,
    *,
    fit_steps: int | None = None,
    resample_count: int = RESAMPLES,
    seed: int = 0,
    batch_size: int = 64,
    memory: Memory | None = None,
    progress: Progress | None = None,
) -> Scores:
    """Is the geometry the true one? SIDE and MAD on rendered images with exact depth, beside controls.

    Errors of albedo, light and camera follow where the truth has them, then those of the reconstruction.

    Args:
        model: a model, or the name or folder of one.
        truth: images with exact depth at the model's size, or the path of a rendered set (or of folders
            image/ and depth/ with PNGs side by side).
        fit_steps: steps of per-image optimisation; None or 0 for none.
        resample_count: bootstrap resamples of the images.
        seed: of the untrained model's weights.
        batch_size: images at a time; changes speed and memory only.
        memory: cache of the scores.
        progress: called with (images done, images in all).
    """
    model = as_model(model)
    exact = truth if isinstance(truth, GroundTruth) else read_ground_truth(truth, image_size=model.image_size)
    names = ("images", "depth", "mask", "normal", "albedo", "light", "camera")
    known = {name: getattr(exact, name) for name in names if getattr(exact, name) is not None}
    inputs = {**_facts(model), **known, "seed": seed, "fitted": fit_steps or 0}
    scored, twin, kept = _optimised(model, fit_steps), untrained_twin(model, seed), memory or Memory()
    found = kept.recall_value(
        "geometry", inputs, GeometryResult,
        lambda: evaluate_geometry(scored, exact, batch_size=batch_size, untrained=twin, progress=progress),
    )  # fmt: skip
    rows = {"geometry": found.rows(resample_count)}
    tables, notes = [found.table(rows["geometry"])], image_verdicts(rows["geometry"][0], GEOMETRY)
    values: dict[str, Any] = {"pictures": len(exact), "geometry": found}
    if {"albedo", "light", "camera"} <= set(known):
        factors, fresh = (
            kept.recall_value(
                f"factors-{name}", inputs, FactorResult,
                lambda one=one: evaluate_factors(one, exact, batch_size=batch_size),
            )
            for name, one in (("model", scored), ("untrained", twin))
        )  # fmt: skip
        rows["factors"] = factors.rows(fresh, resample_count)
        tables.append(factors.table(fresh, rows["factors"]))
        notes += image_verdicts(rows["factors"][0], FACTORS)
        values |= {"factors": factors, "factors_untrained": fresh}
    again = kept.recall_value(
        "reconstruction", inputs, ReconstructionResult,
        lambda: evaluate_reconstruction(
            scored, exact.images, components_of=exact.images, untrained=twin, batch_size=batch_size
        ),
    )  # fmt: skip
    rows["reconstruction"] = again.rows(resample_count)
    tables.append(again.table(rows["reconstruction"]))
    intervals = {name: {row.name: row.numbers() for row in scored} for name, scored in rows.items()}
    return Scores(tables, {**values, "reconstruction": again, "intervals": intervals}, notes, result=found)


def reconstruction(
    model: Derenderer | str | Path,
    images: ImageSet | str | Path,
    *,
    training_images: ImageSet | None = None,
    fit_steps: int | None = None,
    resample_count: int = RESAMPLES,
    seed: int = 0,
    batch_size: int = 64,
    memory: Memory | None = None,
    progress: Progress | None = None,
) -> Scores:
    """How well are images reconstructed? L1, PSNR and SSIM inside the mask, beside controls.

    These are the mean image, 64 principal components of the pixels, and an untrained model.

    Args:
        model: a model, or the name or folder of one.
        images: an image set at the model's size, or the path of a data set; best unseen in training.
        training_images: give the mean image and the components (of at most 2,000); by default ``images``.
        fit_steps, resample_count, seed, batch_size, memory, progress: as of ``geometry``.
    """
    model = as_model(model)
    pictures = as_images(images, model.image_size)
    known = (training_images or pictures).images
    chosen = known[np.linspace(0, len(known) - 1, min(len(known), COMPONENT_IMAGES)).astype(int)]
    inputs = {
        **_facts(model), "images": pictures.images, "fitted": known, "seed": seed, "fit_steps": fit_steps or 0
    }  # fmt: skip
    scored = _optimised(model, fit_steps)
    found = (memory or Memory()).recall_value(
        "reconstruction", inputs, ReconstructionResult,
        lambda: evaluate_reconstruction(
            scored, pictures.images, mean=mean_picture(known), components_of=chosen,
            untrained=untrained_twin(model, seed), batch_size=batch_size, progress=progress,
        ),
    )  # fmt: skip
    rows = found.rows(resample_count)
    values = {
        "pictures": len(pictures),
        "reconstruction": found,
        "intervals": {row.name: row.numbers() for row in rows},
    }
    return Scores([found.table(rows)], values, image_verdicts(rows[0], RECONSTRUCTION), result=found)


def _facts(model: Derenderer) -> dict[str, Any]:
    """Everything that a model's renderings depend on."""
    return {"weights": model_fingerprint(model), "model": model.settings.model_dump(mode="json")}


def _optimised(model: Derenderer, steps: int | None) -> "Derenderer | _Optimised":
    """The model, or with steps one whose scenes are optimised per image."""
    if not steps:
        return model
    require_fitting(model)
    return _Optimised(model, steps)


class _Optimised:
    def __init__(self, model: Derenderer, steps: int):
        self.model, self.steps = model, steps

    def decompose(self, images: Float[Tensor, "n 3 h w"]) -> Scene:
        return self.model.fit_scenes(images, self.steps).scene

    def reconstruct(self, images: Float[Tensor, "n 3 h w"]) -> Rendering:
        return self.model.render(self.decompose(images))

    def __getattr__(self, name: str) -> Any:
        return getattr(self.model, name)
