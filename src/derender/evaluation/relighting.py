"""Relighting against photographs: one image of a person in the light of another person's image.

Images have known light, such as the cropped Extended Yale B. Each person's most frontal image takes the light
that a model predicts for the next person's image in a light. The result is compared with the person's own
image in that light, where the model draws a surface. Controls know the same two people: the image as it is,
the mean image of all others in that light, and the image times the ratio of the other person's two. Leaves
out cast shadows.
"""

from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from derender.data import ImageSet
from derender.data.image_set import as_float
from derender.evaluation.bootstrap import numbers_of
from derender.evaluation.image_scores import binned_rows, image_verdicts
from derender.evaluation.options import Options
from derender.evaluation.pixels import reconstruction_scores
from derender.evaluation.scenes import optimised
from derender.evaluation.score_table import Scores, scored_table
from derender.features import map_batches
from derender.inputs import as_images, as_model
from derender.model import Derenderer
from derender.photo import PhotoDetail
from derender.scene import Scene
from derender.scene.enlarge import at_size

PHOTO_SIZE = 128
BORDER = {"yaleb": (15 / 128, 21 / 128)}
"""By layout, shares of rows and columns at each side that are no part of the photograph, but its edge."""
NEEDED = ("identity", "light_azimuth_deg", "light_elevation_deg", "light_deg")
CONTROLS = ("input", "mean image", "another person's ratio")


def relight(
    model: Derenderer | str | Path,
    images: ImageSet | str | Path,
    *,
    size: int = PHOTO_SIZE,
    fit_steps: int | None = None,
    **options: Any,
) -> Scores:
    """PSNR in decibels and SSIM (at most 1) of relit images against photographs, inside the mask.

    Args:
        model: a model, or the name or folder of one.
        images: the address of images with identity and light, such as the cropped Extended Yale B.
        size: side in pixels of the images that are relit, at least the model's.
        fit_steps: steps of per-image optimisation of the model's scenes.
        options: seed, resamples, dataset, limit, device, progress: fields of ``Options``.

    Raises:
        ValueError: the images lack identity or light, or no two people share two lights.
    """
    how = Options(images=images, **{"keep_duplicates": True, **options})
    model = optimised(as_model(model, device=how.device), fit_steps)
    read = how.at(model.image_size)
    if lacking := [name for name in NEEDED if name not in read.labels]:
        raise ValueError(f"{read.source} has no label {lacking[0]!r}: give images of known light, as Yale B")
    large = read if isinstance(images, ImageSet) else as_images(
        images, size, dataset=how.dataset, limit=how.limit, keep_duplicates=True
    )  # fmt: skip
    batches = map_batches(model.decompose, model, read.images, batch_size=64, progress=how.stage("model"))
    scenes = Scene.joined(batches)
    who, off = read.labels["identity"].astype(str), read.labels["light_deg"]
    lit = list(zip(read.labels[NEEDED[1]].tolist(), read.labels[NEEDED[2]].tolist(), strict=True))
    place = {(person, light): row for row, (person, light) in enumerate(zip(who, lit, strict=True))}
    people, photos, rows = sorted(set(who.tolist())), as_float(large.images), []
    apart: dict[str, dict[str, list[np.ndarray]]] = {"PSNR": {}, "SSIM": {}}
    progress = how.stage("relighting", "people")
    for number, person in enumerate(people):
        others, own = people[number + 1 :] + people[:number], np.flatnonzero(who == person)
        source = int(own[np.argmin(off[own])])
        others = [one for one in others if (one, lit[source]) in place]  # the first of them lends the light
        targets = [int(row) for row in own if row != source and others and (others[0], lit[row]) in place]
        if not targets:
            continue
        rows += targets
        shown = [place[others[0], lit[row]] for row in targets]
        alike = [[place[one, lit[row]] for one in others if (one, lit[row]) in place] for row in targets]
        ratio = photos[shown].clamp(min=0.02) / photos[place[others[0], lit[source]]].clamp(min=0.02)
        with torch.inference_mode():
            target = scenes[[source] * len(shown)].with_parameters(light=scenes.light[shown])
            edited = PhotoDetail(photos[source], scenes[source], model.fov_deg)(target)
            rendered = model.render(at_size(target, photos.shape[-1]))
            mask = _mask(model, scenes[source], photos.shape[-1], read.layout)
        found = {"photograph relit": edited, "model's rendering": rendered}
        found = {name: drawn.image.clamp(0, 1).cpu() for name, drawn in found.items()}
        answers = (
            photos[source].expand_as(ratio),
            torch.stack([photos[near].mean(dim=0) for near in alike]),
            (photos[source] * ratio.clamp(0.05, 20)).clamp(0, 1),
        )
        for name, drawn in {**found, **dict(zip(CONTROLS, answers, strict=True))}.items():
            scores = reconstruction_scores(drawn.float(), photos[targets], mask.expand(len(targets), -1, -1))
            apart["PSNR"].setdefault(name, []).append(scores.psnr_db_each)
            apart["SSIM"].setdefault(name, []).append(scores.ssim_each)
        if progress is not None:
            progress(number + 1, len(people))
    if not rows:
        raise ValueError("no two people have images in the same two lights: nothing to compare")
    tables, notes = [], list(how.notes)
    values: dict[str, Any] = {"pictures": len(rows), "people": len(people)}
    for title, unit, digits in (("PSNR", "dB", 1), ("SSIM", "at most 1", 3)):
        scored, columns, _ = binned_rows(
            {name: np.concatenate(parts) for name, parts in apart[title].items()}, off[rows],
            controls=CONTROLS, groups=who[rows], digits=digits, resample_count=how.resamples, seed=how.seed,
        )  # fmt: skip
        caption = f"Relighting, {title} ({unit}): {len(rows):,} images of {len(people)} people, by light"
        tables.append(scored_table(caption, "prediction", scored, columns, deviations=()))
        values[title.lower()] = numbers_of(scored)
        notes += [f"{title}, {note}" for note in image_verdicts(scored[0], {"all": (columns["all"], 1.0)})]
    return Scores(tables, values, notes)


def _mask(model: Derenderer, scene: Scene, size: int, layout: str) -> Float[Tensor, "1 s s"]:
    """Where the model draws a surface into the photograph, 0 or 1."""
    mask = (model.render(at_size(scene, size)).mask > 0.5).float().cpu()
    down, across = (round(share * size) for share in BORDER.get(layout, (0, 0)))
    inner = torch.zeros_like(mask)
    inner[:, down : size - down, across : size - across] = 1
    return mask * inner
