"""One training step's losses: take apart, render the scene and its flipped twin, compare; then LOOCC.

Source: unsup3d Sec. 3 (reconstruction), Klinghoffer et al. Sec. 3.2 (LOOCC). Every picture is encoded and
decoded once; the twin reuses the decoded maps, and perturbed scenes are rendered in the same call. A batch
may be shared by several devices (distributed.py) and computed in chunks (chunks.py): the losses stay its own.
"""

from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Generator, Tensor

from derender.model import Derenderer
from derender.networks.confidence import Confidence
from derender.objectives.loocc import loocc_loss
from derender.objectives.perceptual import PerceptualFeatures, perceptual_loss
from derender.objectives.reconstruction import depth_curvature, depth_smoothness, masked_l1, photometric_loss
from derender.render import Rendering
from derender.scene import Scene
from derender.scene.perturb import choose_factors
from derender.training.chunks import in_chunks
from derender.training.config import LOOCC_FACTORS, ObjectiveSettings
from derender.training.distributed import ALONE, Ranks
from derender.training.sharing import share_codes

Precision = Callable[[], AbstractContextManager]


@dataclass(frozen=True)
class StepResult:
    """Losses of one batch and what the watcher and the sample sheets look at.

    Attributes:
        total: what is minimised.
        terms: every weighted term of it by name, and the plain masked L1 ("l1"), detached.
        scene: the scenes predicted for the batch.
        rendering: their renderings, without the twins.
        codes: the pictures' features by factor, with gradient, for an objective beside this one.
        confidence: what the confidence net says, where it is used.
    """

    total: Tensor
    terms: dict[str, Tensor]
    scene: Scene
    rendering: Rendering
    codes: dict[str, Tensor]
    confidence: Confidence | None


def training_step(
    model: Derenderer,
    images: Float[Tensor, "n 3 h w"],
    objective: ObjectiveSettings,
    perceptual: PerceptualFeatures | None,
    generator: Generator,
    precision: Precision = nullcontext,
    own: float = 1.0,
    ranks: Ranks = ALONE,
    chunks: int = 1,
) -> StepResult:
    """Losses for one batch of pictures in 0..1; networks run under ``precision``, geometry in float32.

    Args:
        model: takes the pictures apart.
        images: this rank's rows of the batch.
        objective: which terms, and their weights.
        perceptual: features to compare, or None.
        generator: of the perturbations; in the same state on every rank.
        precision: a context for the networks.
        own: each picture's share in its maps (see sharing.py).
        ranks: those that share the batch. Every term is then the rank's part: the mean over ranks is the
            batch's.
        chunks: in how many runs of pictures networks and renderer work, to save memory.
    """
    count = images.shape[0]
    with precision():
        codes = in_chunks(lambda rows: model.encode(rows["images"]), {"images": images}, chunks)
        shared = share_codes(codes, [f.name for f in model.factors if f.mirrored], own, ranks)
        scene = Scene.from_parameters(in_chunks(lambda rows: _parameters(model, rows), shared, chunks))
        confidence = _confidence(model, images, chunks) if objective.confidence else None
    scenes = [scene, model.mirror(scene)]
    left_out = None
    if objective.loocc != "none":
        perturbed, left_out = perturb_one_factor(model, scene, objective, generator, ranks)
        scenes.append(perturbed)
    rendering = _rendered(model, concatenate(scenes), chunks)

    covered = rendering.mask[:count] * rendering.mask[count : 2 * count]
    straight, twin = rendering.image[:count], rendering.image[count : 2 * count]
    part = ranks.part_of_mean(covered)
    terms = {
        "photometric": part * photometric_loss(straight, images, covered, _sigma(confidence, "photometric")),
        "photometric_flip": part
        * objective.flip_weight
        * photometric_loss(twin, images, covered, _sigma(confidence, "photometric_flip")),
    }
    if perceptual is not None and objective.perceptual_weight > 0:
        straight_term, twin_term = _perceptual_terms(
            perceptual, straight, twin, images, covered, confidence, precision, chunks
        )
        terms["perceptual"] = part * objective.perceptual_weight * straight_term
        terms["perceptual_flip"] = part * objective.perceptual_weight * objective.flip_weight * twin_term
    if objective.smoothness_weight > 0:
        terms["smoothness"] = objective.smoothness_weight * depth_smoothness(scene.depth, *_inside(model))
    if objective.curvature_weight > 0:
        terms["curvature"] = objective.curvature_weight * depth_curvature(scene.depth, *_inside(model))
    if left_out is not None:
        seen = fill_uncovered(rendering.image[2 * count :], rendering.mask[2 * count :], images)
        with precision():
            again = in_chunks(lambda rows: model.encode(rows["seen"]), {"seen": seen}, chunks)
        contrast = loocc_loss(
            {name: ranks.gather(code) for name, code in codes.items()},
            {name: ranks.gather(code) for name, code in again.items()},
            ranks.gather(left_out),
            objective.loocc_temperature,
        )
        terms["loocc"] = objective.loocc_weight * contrast
        if objective.cycle_weight > 0:
            terms["cycle"] = objective.cycle_weight * cycle_loss(model, again, scenes[2], objective)

    total = torch.stack(list(terms.values())).sum()
    reported = {name: term.detach() for name, term in terms.items()}
    reported["l1"] = part * masked_l1(straight, images, covered).detach()
    shown = Rendering(image=straight, depth=rendering.depth[:count], mask=rendering.mask[:count])
    return StepResult(total, reported, scene, shown, codes, confidence)


def perturb_one_factor(
    model: Derenderer, scene: Scene, objective: ObjectiveSettings, generator: Generator, ranks: Ranks = ALONE
) -> tuple[Scene, Int[Tensor, " n"]]:
    """Change one factor of every scene, drawn per picture; also which, as an index into ``model.factors``.

    Ranks that share a batch draw for all of it, so that each picture gets what one process would give it.

    Raises:
        ValueError: the model has none of the factors that ``objective.loocc`` names, or cannot perturb one.
    """
    wanted = LOOCC_FACTORS[objective.loocc]
    candidates = [
        i for i, factor in enumerate(model.factors) if factor.name in wanted and factor.perturb is not None
    ]
    if objective.loocc == "all":
        candidates = [i for i, factor in enumerate(model.factors) if factor.perturb is not None]
    if not candidates:
        raise ValueError(
            f"loocc {objective.loocc!r} needs a factor that can be perturbed, this model has none of them"
        )
    chosen = ranks.own(choose_factors(len(scene) * ranks.count, candidates, generator)).to(scene.depth.device)
    changed = {}
    for index in candidates:
        factor = model.factors[index]
        assert factor.perturb is not None
        value = scene.parameters[factor.parameter]
        drawn = ranks.own(
            factor.perturb(ranks.gather(value), generator, objective.perturb, model.settings.ranges)
        )
        rows = (chosen == index).view(-1, *[1] * (value.ndim - 1))
        changed[factor.parameter] = torch.where(rows, drawn, value)
    return scene.with_parameters(**changed), chosen


def fill_uncovered(
    rendered: Float[Tensor, "n 3 h w"], mask: Float[Tensor, "n h w"], pictures: Float[Tensor, "n 3 h w"]
) -> Float[Tensor, "n 3 h w"]:
    """Give pixels that nothing covers the mean colour of the picture's edge.

    Left black, they would tell an encoder how far the camera was turned, which no real picture does.
    """
    edge = torch.cat([pictures[..., 0], pictures[..., -1], pictures[:, :, 0]], dim=-1)
    colour = edge.mean(dim=-1)[:, :, None, None]
    return torch.where(mask[:, None] > 0, rendered, colour)


def cycle_loss(
    model: Derenderer,
    codes_again: dict[str, Float[Tensor, "n _"]],
    shown: Scene,
    objective: ObjectiveSettings,
) -> Float[Tensor, ""]:
    """How far light and camera, read from a rendering, are from those it was rendered with; ours, 0 is best.

    Mean absolute difference (radians, intensities, scene units) over the vector factors that were perturbed,
    with the rendered scene as a fixed target: renderings come with exact labels, so they can teach what a
    picture alone leaves open (pitch above all, which shifted albedo explains nearly as well).
    """
    wanted = LOOCC_FACTORS[objective.loocc]
    differences = []
    for factor in model.factors:
        asked = factor.name in wanted or objective.loocc == "all"
        if factor.mirrored or factor.perturb is None or not asked:
            continue
        raw = model.nets[factor.name].decode(codes_again[factor.name].float())  # type: ignore[operator]
        found = factor.to_parameter(raw, model.settings.ranges)
        differences.append((found - shown.parameters[factor.parameter].detach()).abs().mean())
    return torch.stack(differences).sum() if differences else shown.depth.new_zeros(())


def concatenate(scenes: list[Scene]) -> Scene:
    """Batches of scenes one after the other."""
    return Scene.from_parameters(
        {name: torch.cat([scene.parameters[name] for scene in scenes]) for name in scenes[0].parameters}
    )


def _inside(model: Derenderer) -> tuple[float, int]:
    """Depth range and border columns, for terms that look at the free part of the depth maps."""
    ranges = model.settings.ranges
    return ranges.depth_max - ranges.depth_min, ranges.border_columns(model.image_size)


def _sigma(confidence: Confidence | None, name: str) -> Tensor | None:
    return None if confidence is None else getattr(confidence, name)


def _parameters(model: Derenderer, codes: Mapping[str, Tensor]) -> dict[str, Tensor]:
    return dict(model.decode(dict(codes)).parameters)


def _confidence(model: Derenderer, images: Float[Tensor, "n 3 h w"], chunks: int) -> Confidence:
    maps = in_chunks(lambda rows: vars(model.confidence(rows["images"])), {"images": images}, chunks)
    return Confidence(**maps)


def _rendered(model: Derenderer, scene: Scene, chunks: int) -> Rendering:
    if chunks == 1:
        return model.render(scene)
    return Rendering(
        **in_chunks(lambda rows: vars(model.render(Scene.from_parameters(rows))), scene.parameters, chunks)
    )


def _perceptual_terms(
    perceptual: PerceptualFeatures,
    straight: Float[Tensor, "n 3 h w"],
    twin: Float[Tensor, "n 3 h w"],
    images: Float[Tensor, "n 3 h w"],
    covered: Float[Tensor, "n h w"],
    confidence: Confidence | None,
    precision: Precision,
    chunks: int,
) -> tuple[Tensor, Tensor]:
    """Both perceptual terms; in chunks each counts as much as its pixels that are covered."""
    if chunks == 1:
        return _perceptual_of(perceptual, straight, twin, images, covered, confidence, precision)

    def sums(rows: Mapping[str, Tensor]) -> dict[str, Tensor]:
        seen = rows["covered"]
        sigma = None if confidence is None else Confidence(**{name: rows[name] for name in vars(confidence)})
        terms = _perceptual_of(
            perceptual, rows["straight"], rows["twin"], rows["images"], seen, sigma, precision
        )
        return {"sums": (torch.stack(terms) * seen.sum())[None]}

    columns = {"straight": straight, "twin": twin, "images": images, "covered": covered}
    if confidence is not None:
        columns |= vars(confidence)
    total = in_chunks(sums, columns, chunks)["sums"].sum(dim=0)
    straight_term, twin_term = (total / covered.sum().clamp(min=1)).unbind()
    return straight_term, twin_term


def _perceptual_of(
    perceptual: PerceptualFeatures,
    straight: Float[Tensor, "n 3 h w"],
    twin: Float[Tensor, "n 3 h w"],
    images: Float[Tensor, "n 3 h w"],
    covered: Float[Tensor, "n h w"],
    confidence: Confidence | None,
    precision: Precision,
) -> tuple[Tensor, Tensor]:
    """The perceptual term of the reconstruction and of its twin; uncovered pixels show the picture itself."""
    hole = covered[:, None] == 0
    filled = torch.cat([torch.where(hole, images, straight), torch.where(hole, images, twin)])
    with precision():
        with torch.no_grad():
            target = perceptual(images)
        predicted = perceptual(filled)
    count = images.shape[0]
    return (
        perceptual_loss(predicted[:count], target, covered, _sigma(confidence, "perceptual")),
        perceptual_loss(predicted[count:], target, covered, _sigma(confidence, "perceptual_flip")),
    )
