"""The losses of one training step: decompose, render the scene and its flipped twin, compare; then LOOCC.

Source: unsup3d Sec. 3 (reconstruction), Klinghoffer et al. Sec. 3.2 (LOOCC). The twin reuses the decoded
maps, and perturbed scenes are rendered in the same call. Several devices may share a batch (distributed.py),
and it may be computed in chunks: the losses stay its own.
"""

from collections.abc import Callable, Collection, Mapping
from contextlib import nullcontext
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int, Shaped
from torch import Generator, Tensor
from torch.utils.checkpoint import checkpoint

from derender.model import Derenderer
from derender.networks.decoders import Confidence
from derender.networks.encoders import Images
from derender.objectives.loocc import loocc_loss
from derender.objectives.perceptual import PerceptualFeatures, perceptual_loss
from derender.objectives.reconstruction import depth_smoothness, masked_l1, photometric_loss, relief
from derender.render import Rendering
from derender.scene import Scene
from derender.scene.perturb import choose_factors
from derender.training.config import ObjectiveSettings, loocc_factors
from derender.training.distributed import ALONE, Ranks
from derender.training.task import Precision, StepLosses

Codes = Mapping[str, Float[Tensor, "n _"]]
Columns = Mapping[str, Shaped[Tensor, "n ..."]]
RAISED = 0.1  # half depth ranges by which the mean surface is raised at least, along columns and along rows


@dataclass(frozen=True)
class StepResult(StepLosses):
    """Losses of one batch, weighted but the plain masked L1 ("l1"), and the values the watcher looks at."""

    scene: Scene  # without the twins, as the rendering is
    rendering: Rendering
    codes: dict[str, Tensor]  # by factor, with gradient, for an objective beside this one
    confidence: Confidence | None

    def stages(self) -> dict[str, Tensor]:
        """The output of every stage of the step by name, in the order in which they work."""
        named = {
            "the code of {}": self.codes,
            "the predicted {}": self.scene.parameters,
            "the {} confidence": {} if self.confidence is None else vars(self.confidence),
            "the rendered {}": vars(self.rendering),
            "the loss term {!r}": self.terms,
        }
        return {stage.format(name): value for stage, row in named.items() for name, value in row.items()}


def training_step(
    model: Derenderer, images: Images, objective: ObjectiveSettings,
    perceptual: PerceptualFeatures | None, generator: Generator, precision: Precision = nullcontext,
    own: float = 1.0, ranks: Ranks = ALONE, chunks: int = 1,
) -> StepResult:  # fmt: skip
    """Losses for one batch of images in 0..1; networks run under ``precision``, geometry in float32.

    ``images`` are this rank's rows of the batch; ``generator``, of the perturbations, is in one state on
    every rank. ``own`` is each image's share in its maps (`own_share`). The mean of the terms of all
    ``ranks`` is the batch's. Networks and renderer work in so many ``chunks``, to save memory.
    """
    count = images.shape[0]

    def encode(rows: Columns) -> dict[str, Tensor]:
        return model.encode(rows["images"])

    def confidence(rows: Columns) -> dict[str, Tensor]:
        return vars(model.confidence(rows["images"]))

    with precision():
        codes = in_chunks(encode, {"images": images}, chunks)
        alike = [f.name for f in model.factors if f.mirrored]
        shared = share_codes(codes, alike if objective.template_albedo else ["geometry"], own, ranks)
        values = in_chunks(lambda rows: model.decode(dict(rows)).parameters, shared, chunks)
        sigmas = in_chunks(confidence, {"images": images}, chunks) if objective.confidence else {}
        scene = Scene.from_parameters(values)
    scenes = [scene, model.mirror(scene)]
    left_out = None
    if objective.loocc != "none":
        perturbed, left_out = perturb_one_factor(model, scene, objective, generator, ranks)
        scenes.append(perturbed)
    joined = Scene.joined(scenes).parameters
    rendered = in_chunks(lambda rows: vars(model.render(Scene.from_parameters(rows))), joined, chunks)
    image, mask = rendered["image"], rendered["mask"]
    straight, twin = image[:count], image[count : 2 * count]
    covered = mask[:count] * mask[count : 2 * count]
    part = ranks.part_of_mean(covered)
    flipped = photometric_loss(twin, images, covered, sigmas.get("photometric_flip"))
    weight = objective.photometric_weight
    terms = {
        "photometric": part * weight * photometric_loss(straight, images, covered, sigmas.get("photometric")),
        "photometric_flip": part * weight * objective.flip_weight * flipped,
    }
    if perceptual is not None and objective.perceptual_weight > 0:
        columns = {"straight": straight, "twin": twin, "images": images, "covered": covered, **sigmas}
        straight_term, twin_term = _perceptual_terms(perceptual, columns, precision, chunks)
        terms["perceptual"] = part * objective.perceptual_weight * straight_term
        terms["perceptual_flip"] = part * objective.perceptual_weight * objective.flip_weight * twin_term
    ranges = model.settings.ranges
    inside = ranges.depth_max - ranges.depth_min, ranges.border_columns(model.image_size)
    finer = 2**model.settings.network.doublings  # differences between pixels are of the encoded size
    steps = {"smoothness": objective.smoothness_weight, "curvature": objective.curvature_weight}
    for order, (name, weight) in enumerate(steps.items(), 1):
        if weight > 0:
            terms[name] = finer**order * weight * depth_smoothness(scene.depth, *inside, order)
    if objective.raised_weight > 0:
        missing = RAISED - ranks.gather(relief(scene.depth, *inside)).mean(dim=0)
        terms["raised"] = objective.raised_weight * missing.clamp(min=0).sum()
    if ranges.lean_deg and objective.lean_weight > 0:
        pitch = ranks.gather(scene.camera[:, 0])
        pairs = pitch.sum().square() - pitch.square().sum()  # the square of the mean would shrink the spread
        terms["lean"] = objective.lean_weight * pairs / max(len(pitch) * (len(pitch) - 1), 1)
    if model.renderer.penalty is not None:
        terms["penalty"] = model.renderer.penalty(scene, model.renderer.shading(scene, model.fov_deg))
    if left_out is not None:
        seen = {"images": fill_uncovered(image[2 * count :], mask[2 * count :], images)}
        with precision():
            again = in_chunks(encode, seen, chunks)
        first, second = ({name: ranks.gather(code) for name, code in one.items()} for one in (codes, again))
        changed, temperature = ranks.gather(left_out), objective.loocc_temperature
        contrast = loocc_loss(first, second, changed, temperature, joint=objective.loocc_joint)
        terms["loocc"] = objective.loocc_weight * contrast
        if objective.cycle_weight > 0:
            terms["cycle"] = objective.cycle_weight * cycle_loss(model, again, scenes[2], objective)

    total = torch.stack(list(terms.values())).sum()
    reported = {name: term.detach() for name, term in terms.items()}
    reported["l1"] = part * masked_l1(straight, images, covered).detach()
    shown = Rendering(image=straight, depth=rendered["depth"][:count], mask=mask[:count])
    return StepResult(total, reported, scene, shown, codes, Confidence(**sigmas) if sigmas else None)


def perturb_one_factor(
    model: Derenderer, scene: Scene, objective: ObjectiveSettings, generator: Generator, ranks: Ranks = ALONE
) -> tuple[Scene, Int[Tensor, " n"]]:
    """Change one factor of every scene, drawn per image; also which, as an index into ``model.factors``.

    Ranks draw for all of the batch, as one process would. A ValueError: ``objective.loocc`` names no factor
    of the model that can be perturbed.
    """
    factors = loocc_factors(objective.loocc, model.factors)
    indices = [model.factors.index(factor) for factor in factors]
    chosen = ranks.own(choose_factors(len(scene) * ranks.count, indices, generator))
    chosen = chosen.to(scene.depth.device, non_blocking=True)
    changed = {}
    for index, factor in zip(indices, factors, strict=True):
        assert factor.perturb is not None
        value = scene.parameters[factor.parameter]
        drawn = factor.perturb(ranks.gather(value), generator, objective.perturb, model.settings.ranges)
        changed[factor.parameter] = where_rows(chosen == index, ranks.own(drawn), value)
    return scene.with_parameters(**changed), chosen


def where_rows(rows: Bool[Tensor, " n"], one: Tensor, other: Tensor) -> Tensor:
    """One tensor's rows where ``rows`` is true, else the other's."""
    return torch.where(rows.to(one.device).view(-1, *[1] * (one.ndim - 1)), one, other)


def fill_uncovered(rendered: Images, mask: Float[Tensor, "n h w"], images: Images) -> Images:
    """Give pixels that nothing covers the mean colour of the image's edge."""
    # left black, they would show an encoder how far the camera was turned, which no real image does
    edge = torch.cat([images[..., 0], images[..., -1], images[:, :, 0]], dim=-1)
    return torch.where(mask[:, None] > 0, rendered, edge.mean(dim=-1)[:, :, None, None])


def cycle_loss(
    model: Derenderer, codes_again: Codes, rendered: Scene, objective: ObjectiveSettings
) -> Float[Tensor, ""]:
    """How far light and camera, predicted from a rendering, are from those it was rendered with; best 0.

    Mean absolute difference (radians, intensities, scene units) over the perturbed vector factors. The
    rendered scene is a fixed, exact target for what an image alone leaves open (pitch above all).
    """
    total = rendered.depth.new_zeros(())
    for factor in loocc_factors(objective.loocc, model.factors):
        if not factor.mirrored:
            raw = model.nets[factor.name].decoder(codes_again[factor.name].float())
            predicted = factor.to_parameter(raw, model.settings.ranges)
            total = total + (predicted - rendered.parameters[factor.parameter].detach()).abs().mean()
    return total


def in_chunks(function: Callable[[Columns], Columns], inputs: Columns, chunks: int) -> dict[str, Tensor]:
    """Apply a function of rows to ``inputs`` in chunks of rows, each computed again in backward.

    A row's output must not depend on other rows, as under batch norm. Source: gradient caching (Gao et al.
    2021), through torch's activation checkpointing.
    """
    if chunks == 1:
        return dict(function(inputs))
    pieces = zip(*(column.chunk(chunks) for column in inputs.values()), strict=True)
    rows = [dict(zip(inputs, piece, strict=True)) for piece in pieces]
    done = [checkpoint(function, row, use_reentrant=False, preserve_rng_state=False) for row in rows]
    return {name: torch.cat([columns[name] for columns in done]) for name in done[0]}


def own_share(objective: ObjectiveSettings, done: float) -> float:
    """The template start: an image's share in its own maps at this share of the run, 0 (all shared) to 1."""
    if done < objective.template_share:
        return 0.0  # only camera and light can explain how images differ, so both are learnt
    if objective.release_share == 0:
        return 1.0
    return min((done - objective.template_share) / objective.release_share, 1.0)


def share_codes(codes: Codes, names: Collection[str], own: float, ranks: Ranks = ALONE) -> Codes:
    """The codes of the named factors moved to their mean over the batch; ``own`` = 1 leaves them."""
    shared = dict(codes)
    for name in names if own < 1 else ():
        code = codes[name]
        mean = ranks.gather(code).mean(dim=0, keepdim=True).to(code.dtype)
        shared[name] = torch.lerp(mean.expand_as(code), code, own)
    return shared


def _perceptual_terms(
    perceptual: PerceptualFeatures, columns: Columns, precision: Precision, chunks: int
) -> Float[Tensor, "2"]:
    """The terms of the reconstruction and of its twin, by covered pixels; others show the image itself."""
    if chunks > 1:

        def weighted(rows: Columns) -> dict[str, Tensor]:
            return {"sums": (_perceptual_terms(perceptual, rows, precision, 1) * rows["covered"].sum())[None]}

        sums = in_chunks(weighted, columns, chunks)["sums"].sum(dim=0)
        return sums / columns["covered"].sum().clamp(min=1)
    images, covered = columns["images"], columns["covered"]
    hole = covered[:, None] == 0
    filled = torch.cat([torch.where(hole, images, columns[name]) for name in ("straight", "twin")])
    with precision():
        target, predicted = perceptual(images), perceptual(filled)
    halves = zip(("perceptual", "perceptual_flip"), predicted.split(len(images)), strict=True)
    return torch.stack([perceptual_loss(half, target, covered, columns.get(name)) for name, half in halves])
