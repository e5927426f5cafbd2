"""Is albedo as bright as the surface is, or does a dark surface pass for dim light? Is relighting true?

On rendered images with true albedo: mean brightness (luma, 0..1) of predicted albedo over the object against
the true one, and distance of their mean colours. The predicted light should not know the true brightness.
Photographs have no true albedo, but groups of people differ in the brightness of their images. Albedo takes a
share of that difference: 1 where light is the same for all groups, 0 where the model explains skin by light.

Relighting against photographs of known light, such as the cropped Extended Yale B. Each person's most frontal
image takes the light that a model predicts for the next person's image in a light. The result is compared
with the person's own image in that light, where the model draws a surface. Controls know the same two people.
Leaves out cast shadows.
"""

from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from derender.baselines.controls import LUMINANCE, untrained_twin
from derender.data import ImageSet, as_float, read_ground_truth
from derender.evaluation.angles import agreement, agreement_table
from derender.evaluation.bootstrap import Estimate, ScoredRow, estimate, numbers_of
from derender.evaluation.image_scores import binned_rows, image_rows
from derender.evaluation.options import Options
from derender.evaluation.pixels import ReconstructionScores, reconstruction_scores
from derender.evaluation.scenes import optimised
from derender.evaluation.score_table import Column, Scores, scored_table, verdict
from derender.features import map_batches, missing
from derender.features.extract import check_size
from derender.inputs import Progress, as_images, as_model
from derender.model import Derenderer
from derender.photo import PhotoDetail, editable_scenes
from derender.scene import Scene
from derender.scene.enlarge import at_size

LUMA = np.array(LUMINANCE)
_LIGHT = Column("light r", None, note="correlation of mean shading with true brightness of albedo, best 0")
_CHROMA = Column("chroma error", "low", 4, "distance of mean colours divided by their sums, best 0")
_SHARE = Column("share", None, note="of the groups' difference in brightness that albedo takes, best 1")


def brightness(
    model: Derenderer | str | Path, images: ImageSet | str | Path, *, by: str | None = None,
    fit_steps: int | None = None, **options: Any,
) -> Scores:  # fmt: skip
    """Is albedo as bright as the surface? Slope and r best 1, chroma error and correlation of light best 0.

    Args:
        model: a model, or the name or folder of one.
        images: the address of a rendered set with true albedo; with ``by`` any images.
        by: a label of groups of people: compare their mean albedo, without truth.
        fit_steps: steps of per-image optimisation of the model's scenes.
        options: seed, resamples, dataset, limit, device, progress: fields of ``Options``.

    Raises:
        ValueError: the set has no true albedo, or the label fewer than two groups.
    """
    how = Options.of(options, images=images)
    model = as_model(model, device=how.device)
    nets = {"model": optimised(model, fit_steps), "untrained model": untrained_twin(model, how.seed)}
    if by is not None:
        return _by_group(nets, how.at(model.image_size), by, how)
    if isinstance(images, ImageSet):
        raise ValueError("an image set holds no true albedo: give the address of a rendered set, or by")
    try:
        truth = read_ground_truth(images, limit=how.limit, image_size=model.image_size)
    except ValueError as error:
        raise ValueError(f"{error}; for photographs name a label of groups (--by LABEL)") from error
    check_size(model, truth.images, rendered=True)
    if truth.albedo is None:
        raise ValueError(f"{images} stores no true albedo: give a set that does, or by (--by LABEL)")
    seen = {name: surfaces(net, truth.images, truth.mask, how.stage(name)) for name, net in nets.items()}
    inside = truth.mask[:, None]
    mean = (truth.albedo * inside).sum(axis=(2, 3)) / inside.sum(axis=(2, 3))
    nothing = np.ones(len(mean))
    seen["image as albedo"] = {"albedo": seen["model"]["image"], "light": nothing}
    people = truth.labels.get("identity", np.arange(len(mean))).astype(str)
    weights = how.drawn(people)
    caption = f"Brightness of albedo, 0 to 1: {len(mean):,} images of {len(set(people))} surfaces"
    bright = {name: one["albedo"] @ LUMA for name, one in seen.items()}
    table, numbers = agreement_table(caption, bright, mean @ LUMA, weights, digits=3)
    seen["constant answer"] = {"albedo": np.tile(mean.mean(axis=0), (len(mean), 1)), "light": nothing}
    apart = {name: {"chroma": _apart(one["albedo"], mean)} for name, one in seen.items()}
    rows = image_rows(apart, {"chroma": _CHROMA}, weights)
    light = {name: agreement(one["light"], mean @ LUMA, weights)["r"] for name, one in seen.items()}
    rows = [replace(row, scores={**row.scores, "light": light[row.name]}) for row in rows]
    columns = {"chroma": _CHROMA, "light": _LIGHT}
    every = {"intervals": tuple(columns), "deviations": ()}
    colour = scored_table("Colour and light", "prediction", rows, columns, **every)
    values = {"pictures": len(mean), "brightness": numbers, "colour": numbers_of(rows)}
    return Scores([table, colour], values, how.notes)


def surfaces(
    net: Any, images: np.ndarray, masks: np.ndarray | None = None, progress: Progress | None = None
) -> dict[str, np.ndarray]:
    """Means over the drawn surface (and the mask, (N, H, W)) of each image: (N, 3) colours of ``albedo`` and
    ``image``, (N,) ``light``, the mean shading. Where nothing is drawn they are 0.
    """

    def see(batch: Tensor) -> tuple[Tensor, ...]:
        scene = net.decompose(batch)
        plain = torch.tensor([1.0, 0.0, 0.0, 0.0], device=batch.device).expand_as(scene.light)
        white = scene.with_parameters(albedo=torch.ones_like(scene.albedo))
        flat, lit = net.render(scene.with_parameters(light=plain)), net.render(white)
        shading = lit.image.mean(dim=1, keepdim=True)
        return flat.image.cpu(), shading.cpu(), batch.cpu(), flat.mask[:, None].cpu() > 0.5

    parts = map_batches(see, net, images, batch_size=64, progress=progress)
    *maps, inside = map(torch.cat, zip(*parts, strict=True))
    if masks is not None:
        inside = inside & torch.from_numpy(masks > 0)[:, None]
    count = inside.sum(dim=(2, 3)).clamp(min=1)
    albedo, light, image = (((one * inside).sum(dim=(2, 3)) / count).double().numpy() for one in maps)
    return {"albedo": albedo, "light": light[:, 0], "image": image}


def _by_group(nets: Mapping[str, Any], images: ImageSet, by: str, how: Options) -> Scores:
    """Mean brightness of images, albedo and light by group, and the share of the difference albedo takes."""
    images = images.select(~missing(images.label(by)))
    group = images.label(by).astype(str)
    names = sorted(set(group))
    if len(names) < 2:
        raise ValueError(f"{by!r} has {len(names)} groups: two or more are needed")
    seen = {name: surfaces(net, images.images, None, how.stage(name)) for name, net in nets.items()}
    weights = how.drawn(len(group)).astype(np.float64)
    member = (group[:, None] == names).astype(np.float64)

    def means(values: np.ndarray) -> np.ndarray:
        return (weights * values) @ member / np.maximum(weights @ member, 1e-9)

    def share(bright: np.ndarray) -> Estimate:
        both = (np.log(np.maximum(means(one), 1e-6)) for one in (bright, picture))
        own, shown = (one - one.mean(axis=1, keepdims=True) for one in both)
        values = (own * shown).sum(axis=1) / (shown * shown).sum(axis=1)
        return estimate(values[:1], values[1:])

    picture = seen["model"]["image"] @ LUMA
    shown = {"image": picture, "albedo": seen["model"]["albedo"] @ LUMA, "light": seen["model"]["light"]}
    result = {what: means(one) for what, one in shown.items()}
    groups = []
    for at, name in enumerate(names):
        scores = {what: estimate(own[:1, at], own[1:, at]) for what, own in result.items()}
        groups.append(ScoredRow(f"{name} ({(group == name).sum():,})", False, 1, scores))
    columns = {what: Column(what, None, note="mean brightness, 0 to 1") for what in result}
    columns["light"] = Column("light", None, note="mean shading")
    answers = {name: one["albedo"] @ LUMA for name, one in seen.items()} | {"image as albedo": picture}
    shares = [ScoredRow(name, name != "model", 1, {"share": share(one)}) for name, one in answers.items()]
    caption = f"Brightness of {by}, {len(group):,} images"
    tables = [
        scored_table(caption, "prediction", shares, {"share": _SHARE}, deviations=()),
        scored_table(f"Brightness by {by}", by, groups, columns, intervals=tuple(columns), deviations=()),
    ]
    values = {"pictures": len(group), "share": numbers_of(shares), "groups": numbers_of(groups)}
    return Scores(tables, values, how.notes)


def _apart(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Distance between colours divided by their sums, (N,)."""
    a, b = (one / np.maximum(one.sum(axis=1, keepdims=True), 1e-9) for one in (a, b))
    return np.linalg.norm(a - b, axis=1)


BORDER = {"yaleb": (15 / 128, 21 / 128)}  # by layout, shares of rows and columns at each side that are edge
NEEDED = ("identity", "light_azimuth_deg", "light_elevation_deg", "light_deg")
CONTROLS = ("input", "mean image", "another person's ratio")


def relight(
    model: Derenderer | str | Path, images: ImageSet | str | Path, *, size: int = 128,
    fit_steps: int | None = None, **options: Any,
) -> Scores:  # fmt: skip
    """PSNR in decibels and SSIM (at most 1) of relit images against photographs, inside the mask.

    Args:
        model: a model, or the name or folder of one.
        images: the address of images with identity and light, such as the cropped Extended Yale B.
        size: side in pixels of the images that are relit, at least the model's.
        fit_steps: steps of per-image optimisation of the scenes; by default those of edits.
        options: seed, resamples, dataset, limit, device, progress: fields of ``Options``.

    Raises:
        ValueError: the images lack identity or light, or no two people share two lights.
    """
    how = Options.of(options, images=images, keep_duplicates=True)
    model = as_model(model, device=how.device)
    read = how.at(model.image_size)
    if lacking := [name for name in NEEDED if name not in read.labels]:
        raise ValueError(f"{read.source} has no label {lacking[0]!r}: give images of known light, as Yale B")
    same: dict[str, Any] = {"dataset": how.dataset, "limit": how.limit, "keep_duplicates": True}
    large = read if isinstance(images, ImageSet) else as_images(images, size, **same)
    scenes_of = partial(editable_scenes, model, steps=fit_steps)
    batches = map_batches(scenes_of, model, read.images, batch_size=64, progress=how.stage("model"))
    scenes = Scene.joined(batches)
    who, off = read.labels["identity"].astype(str), read.labels["light_deg"]
    lit = list(zip(read.labels[NEEDED[1]].tolist(), read.labels[NEEDED[2]].tolist(), strict=True))
    place = {(person, light): row for row, (person, light) in enumerate(zip(who, lit, strict=True))}
    people, photos, rows = sorted(set(who.tolist())), as_float(large.images), []
    down, across = (round(share * photos.shape[-1]) for share in BORDER.get(read.layout, (0, 0)))
    photographed = torch.zeros(photos.shape[-2:])  # 1 where a photograph is not its border
    photographed[down : len(photographed) - down, across : len(photographed) - across] = 1
    apart: dict[str, list[ReconstructionScores]] = {}
    progress = how.stage("relighting", "people")
    for number, person in enumerate(people):
        progress(number + 1, len(people))
        others, own = people[number + 1 :] + people[:number], np.flatnonzero(who == person)
        source = int(own[np.argmin(off[own])])
        others = [one for one in others if (one, lit[source]) in place]  # the first of them lends the light
        targets = [int(row) for row in own if row != source and others and (others[0], lit[row]) in place]
        if not targets:
            continue
        rows += targets
        lent = [place[others[0], lit[row]] for row in targets]
        alike = [[place[one, lit[row]] for one in others if (one, lit[row]) in place] for row in targets]
        ratio = photos[lent].clamp(min=0.02) / photos[place[others[0], lit[source]]].clamp(min=0.02)
        with torch.inference_mode():
            target = scenes[[source] * len(lent)].with_parameters(light=scenes.light[lent])
            edited = PhotoDetail(photos[source], scenes[source], model.fov_deg)(target)
            rendered = model.render(at_size(target, photos.shape[-1]))
            drawn = model.render(at_size(scenes[source], photos.shape[-1])).mask > 0.5
        mask = drawn.float().cpu() * photographed
        mean = torch.stack([photos[near].mean(dim=0) for near in alike])
        copied = photos[source].expand_as(ratio), mean, photos[source] * ratio.clamp(0.05, 20)
        answers = (edited.image, rendered.image, *copied)
        for name, drawn in zip(("photograph relit", "model's rendering", *CONTROLS), answers, strict=True):
            shown, covered = drawn.float().cpu().clamp(0, 1), mask.expand(len(targets), -1, -1)
            apart.setdefault(name, []).append(reconstruction_scores(shown, photos[targets], covered))
    if not rows:
        raise ValueError("no two people have images in the same two lights: nothing to compare")
    tables, notes = [], list(how.notes)
    values: dict[str, Any] = {"pictures": len(rows), "people": len(set(who[rows]))}
    weights = how.drawn(who[rows])
    for title, score, unit, digits in (("PSNR", "psnr_db", "dB", 1), ("SSIM", "ssim", "at most 1", 3)):
        parts = {name: [getattr(one, f"{score}_each") for one in scores] for name, scores in apart.items()}
        each = {name: np.concatenate(own) for name, own in parts.items()}
        scored, columns, _ = binned_rows(each, off[rows], weights, CONTROLS, digits=digits)
        caption = f"Relighting, {title} ({unit}): {len(rows):,} images of {values['people']} people, by light"
        tables.append(scored_table(caption, "prediction", scored, columns, deviations=()))
        values[title.lower()] = numbers_of(scored)
        notes.append(f"{title}, {verdict(scored[0], 'all', columns['all'])}")
    return Scores(tables, values, notes)
