"""Protocols of decomposed scenes: are geometry, albedo, light and camera the true ones, and the images alike?

Every score is beside constant answers and the same networks untrained. With ``fit_steps`` the model's scenes,
not the untrained one's, are optimised against their images first. ``copy_cost`` measures how near a copy,
such as one of rounded weights, comes to its model. The unit is how far two of these images are apart.
"""

import copy
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from derender.baselines.controls import untrained_twin
from derender.data import GivenImages, GroundTruth, ImageSet, as_batch, read_ground_truth
from derender.data.source import evenly_spaced
from derender.evaluation import pixels
from derender.evaluation.bootstrap import numbers_of
from derender.evaluation.image_scores import ImageResult
from derender.evaluation.memory import content_hash
from derender.evaluation.options import Options
from derender.evaluation.score_table import Scores, verdict
from derender.evaluation.truth import FactorResult, GeometryResult, evaluate_factors, evaluate_geometry
from derender.features import Progress, embed_images, model_fingerprint
from derender.inputs import as_images, as_model
from derender.model import Derenderer
from derender.scene import Scene

SCENES_KEPT = 512 * 1024**2  # bytes of images whose optimised scenes are kept while a model is scored
Protocols = dict[str, tuple[type[ImageResult], Callable[[], Any]]]  # the result's class, a call that makes it


def geometry(
    model: Derenderer | str | Path, truth: GroundTruth | str | Path, *, fit_steps: int | None = None,
    batch_size: int = 64, **options: Any,
) -> Scores:  # fmt: skip
    """Is the geometry the true one? SIDE and MAD on rendered images with exact depth, beside controls.

    Errors of albedo, light and camera follow where the truth has them, then those of the reconstruction.

    Args:
        model: a model, or the name or folder of one.
        truth: images with exact depth at the model's size, or the path of a rendered set, or of folders
            image/ and depth/ with PNGs.
        fit_steps: steps of per-image optimisation; None or 0 for none.
        batch_size: images at a time; changes speed and memory only.
        options: seed (of the untrained weights), resamples, limit, device, cache, progress: fields of
            ``Options``.
    """
    how = Options.of(options)
    model = as_model(model, device=how.device)
    if not isinstance(truth, GroundTruth):
        truth = read_ground_truth(truth, limit=how.limit, image_size=model.image_size)
    known = {name: maps for name, maps in vars(truth).items() if isinstance(maps, np.ndarray)}
    scored = optimised(model, fit_steps)
    same: dict[str, Any] = {"batch_size": batch_size, "untrained": untrained_twin(model, how.seed)}
    first = partial(evaluate_geometry, scored, truth, progress=how.progress, **same)
    again = partial(pixels.evaluate_reconstruction, scored, truth.images, components_of=truth.images, **same)
    protocols: Protocols = {"geometry": (GeometryResult, first)}
    if {"albedo", "light", "camera"} <= set(known):
        protocols["factors"] = FactorResult, partial(evaluate_factors, scored, truth, **same)
    protocols["reconstruction"] = pixels.ReconstructionResult, again
    return _scored(model, protocols, {**known, "seed": how.seed, "steps": fit_steps or 0}, how)


def reconstruction(
    model: Derenderer | str | Path, images: ImageSet | str | Path, *,
    training_images: ImageSet | None = None, fit_steps: int | None = None, batch_size: int = 64,
    **options: Any,
) -> Scores:  # fmt: skip
    """How well are images reconstructed? L1, PSNR and SSIM inside the mask, beside controls.

    These are the mean image, 64 principal components of the pixels, and an untrained model.

    Args:
        model: a model, or the name or folder of one.
        images: an image set at the model's size, or the path of a data set; best unseen in training.
        training_images: give the mean image and the components (of at most 2,000); by default ``images``.
        fit_steps, batch_size, options: as of ``geometry``.
    """
    how = Options.of(options)
    model = as_model(model, device=how.device)
    images = as_images(images, model.image_size, dataset=how.dataset, limit=how.limit)
    known = (training_images or images).images
    same: dict[str, Any] = {"batch_size": batch_size, "untrained": untrained_twin(model, how.seed)}
    fitted = known[evenly_spaced(len(known), pixels.COMPONENT_IMAGES)]
    same |= {"mean": pixels.mean_image(known), "components_of": fitted, "progress": how.progress}
    make = partial(pixels.evaluate_reconstruction, optimised(model, fit_steps), images.images, **same)
    inputs = {"images": images.images, "fitted": known, "seed": how.seed, "steps": fit_steps or 0}
    result = _scored(model, {"reconstruction": (pixels.ReconstructionResult, make)}, inputs, how)
    intervals = result.values["intervals"]["reconstruction"]
    return replace(result, values={**result.values, "intervals": intervals})


def _scored(model: Derenderer, protocols: Protocols, inputs: Mapping[str, Any], how: Options) -> Scores:
    """Results of protocols, from the cache if the same model and inputs gave them before."""
    settings = model.settings.model_dump(mode="json")
    inputs = {"weights": model_fingerprint(model), "model": settings, **inputs}
    result = {name: how.memory.recall_value(name, inputs, *protocol) for name, protocol in protocols.items()}
    rows = {name: one.rows(how.resamples, how.seed) for name, one in result.items()}
    notes = [verdict(rows[name][0], *one) for name in rows for one in result[name].columns.items()]
    intervals = {name: numbers_of(scored) for name, scored in rows.items()}
    values = {"pictures": len(inputs["images"]), **result, "intervals": intervals}
    tables = [one.table(rows[name]) for name, one in result.items()]
    return Scores(tables, values, [*notes, how.memory.summary()], result=next(iter(result.values())))


def optimised(model: Derenderer, steps: int | None) -> Derenderer:
    """The model, or with steps one whose scenes are optimised per image: once for all protocols that ask."""
    if not steps:
        return model
    model.features.required_fitting("this model")
    known: dict[str, Scene] = {}

    def decompose(images: GivenImages) -> Scene:
        batch = as_batch(images, model.image_size, model.device)
        key = content_hash({"images": batch.numpy(force=True)})
        scene = known[key] if key in known else model.fit_scenes(batch, steps).scene
        if len(known) * batch.nbytes < SCENES_KEPT:
            known[key] = scene
        return scene

    fitted = copy.copy(model)
    fitted.decompose = decompose
    return fitted


def copy_cost(
    model: Derenderer, other: Derenderer, images: np.ndarray, *, progress: Progress | None = None
) -> dict[str, Any]:
    """Compare a copy of a model, ``other``, with it on two or more uint8 images (N, 3, H, W).

    ``moved``: by factor how far an image's feature moved: the mean, over the root mean square distance of two
    images. ``l1``, ``l1_before``: mean absolute error of the images re-rendered by the copy, and by the
    model. ``progress`` is called with (features made, features to make), two of each image.
    """
    passes = []
    for number, one in enumerate((model, other)):
        report = progress and partial(lambda start, done, of: progress(start * of + done, 2 * of), number)
        passes.append(embed_images(one, images, progress=report))
    moved = {}
    for name, feature in passes[0].items():
        own, moved_to = np.asarray(feature, np.float64), np.asarray(passes[1][name], np.float64)
        apart = np.sqrt(2 * own.var(axis=0, ddof=1).sum())  # of two images drawn at random
        moved[name] = float(np.linalg.norm(own - moved_to, axis=1).mean() / apart) if apart else 0.0
    after, before = (pixels.evaluate_reconstruction(one, images).model.l1 for one in (other, model))
    return {"moved": moved, "l1": after, "l1_before": before}
