"""Detects a training that fails while its loss still falls, and explains it in plain words.

Each sign (signs.yaml) is a number measured on training batches, smoothed, and compared with a limit. A sign
that stays on for a while is a finding. Limits were set on healthy and collapsed runs (lab/log.md), times on
batches of 16: networks recover by updates, so larger batches get as many updates, not as many images.

NaN and infinity are looked for at every stage: a depth of NaN covers no pixel, and so does not reach the
loss.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn

from derender.scene import Scene
from derender.scene.light import lambert_shading
from derender.scene.normals import normals_from_depth
from derender.scene.ranges import SceneRanges
from derender.storage.bounded import table_beside
from derender.training.distributed import ALONE, Ranks

USUAL_BATCH = 16
GRACE_IMAGES = 4_000  # a network that has just started has no geometry yet
PERSISTENCE_IMAGES = 4_000  # how long a sign must stay on
MEMORY_IMAGES = 2_000  # over how many images measurements are averaged
INVERTED = {"depth": (0,), "light": (2, 3), "camera": (0, 1)}  # outputs whose sign an inverted relief changes
INVERSION = ("", "due", "done")
SLOWER = "use a smaller learning_rate (1e-4 or less), a weight_decay of 5e-4 and warmup_images"


@dataclass(frozen=True)
class Finding:
    """A problem of a run: its short name, the problem in plain words, what to change, whether to stop."""

    sign: str
    text: str
    advice: str
    fatal: bool


@dataclass(frozen=True)
class Sign:
    """A row of ``signs.yaml``: a measurement, its limit and its meaning."""

    name: str
    measure: str
    limit: float
    above: bool  # the sign is on when the measurement is above the limit (else below)
    fatal: bool
    text: str  # {value} is the measurement
    advice: str  # {slower} is what all advice to learn slower has in common
    grace_images: int = GRACE_IMAGES
    usual_images: int = 0  # how long a healthy run may show it
    invert: float | None = None  # below it reliefs are inverted, once in a run, which then continues

    def is_on(self, measured: float) -> bool:
        return measured > self.limit if self.above else measured < self.limit


SIGNS = tuple(Sign(name, **row) for name, row in table_beside(__file__, "signs.yaml").items())
MEASURES = tuple(dict.fromkeys(sign.measure for sign in SIGNS))


def largest_gradients(model: nn.Module) -> tuple[list[str], Float[Tensor, " n"]]:
    """Names of all gradients, and on the device the largest absolute value of each, NaN where one is."""
    result = {name: value.grad for name, value in model.named_parameters() if value.grad is not None}
    sizes = torch._foreach_norm(list(result.values()), math.inf)
    return [f"the gradient of {name}" for name in result], torch.stack([size.float() for size in sizes])


def not_finite(what: str) -> Finding:
    """The finding that ends a run with a value that is NaN or infinite."""
    return Finding("non-finite value", f"{what} is not finite", f"{SLOWER}; with bf16, try 32-true", True)


@dataclass
class FiniteWatch:
    """Looks for a loss that is not finite; while ``uneasy``, the present state is no good checkpoint."""

    uneasy: bool = field(default=False, init=False)

    def note(self, result: Any) -> tuple[list[str], Float[Tensor, " n"]]:
        """Names of a step's stages, and on its device what ``look`` needs of its result (`StepLosses`)."""
        stages, measured = self.parts(result)
        finite = [value.detach().isfinite().all() for value in stages.values()]
        values = [result.total.detach(), *finite, *measured]
        return list(stages), torch.stack([value.float() for value in values])

    def parts(self, result: Any) -> tuple[dict[str, Tensor], list[Tensor]]:
        """What has to be finite, by name, and further numbers that ``look`` is given."""
        return result.terms, []

    def look(self, images: int, names: Sequence[str], note: Sequence[float]) -> tuple[Finding, ...]:
        """The problems, usually none, of the step after so many images, by what was noted of it."""
        if math.isfinite(note[0]):
            return ()
        broken = _first(names, note[1:])
        first = "" if broken is None else f"; the first term that is not finite is {broken!r}"
        text, advice = f"the loss is {note[0]}{first}", "use a smaller learning_rate"
        return (Finding("non-finite loss", text, advice, True),)

    def repair(self, model: Any, optimiser: torch.optim.Optimizer) -> str:
        """Mend a model where that is due; in plain words what was done, here never anything."""
        return ""

    def memory(self) -> dict[str, Any]:
        """The state that a resumed run needs to go on watching: here none."""
        return {}


@dataclass
class Watcher(FiniteWatch):
    """The collapse detector: looks at batches, smooths its measurements and notes since when signs are on."""

    ranges: SceneRanges
    batch_size: int
    averages: dict[str, float] = field(default_factory=dict)
    on_since: dict[str, int] = field(default_factory=dict)
    last_images: int = 0
    inversion: str = ""  # of reliefs: "due" or, once in a run, "done"
    ranks: Ranks = ALONE

    @classmethod
    def remembering(
        cls, ranges: SceneRanges, batch_size: int, memory: Mapping[str, Any], ranks: Ranks = ALONE
    ) -> "Watcher":
        """A watcher that continues where ``memory`` was taken, or starts anew; else a ValueError."""
        try:
            watcher = cls(ranges, batch_size, ranks=ranks, **memory)
            numbers = [watcher.last_images, *watcher.averages.values(), *watcher.on_since.values()]
            if all(type(number) in (int, float) for number in numbers) and watcher.inversion in INVERSION:
                return watcher
        except (TypeError, AttributeError):
            pass
        fix = "resume with watch=false, or train in another folder"
        raise ValueError(f"the checkpoint does not hold what the collapse detector remembers: {fix}")

    def memory(self) -> dict[str, Any]:
        averages, on_since = dict(self.averages), dict(self.on_since)
        memory = {"averages": averages, "on_since": on_since, "last_images": self.last_images}
        return {**memory, "inversion": self.inversion}

    def repair(self, model: Any, optimiser: torch.optim.Optimizer) -> str:
        if self.inversion != "due":
            return ""
        invert(model, optimiser)
        self.inversion = "done"
        return "surfaces were hollow: reliefs are inverted, with the signs of turns and lights"

    def parts(self, result: Any) -> tuple[dict[str, Tensor], list[Tensor]]:
        measured = measure(result.scene, self.ranges)
        return result.stages(), [measured[name] for name in MEASURES]

    def look(self, images: int, names: Sequence[str], note: Sequence[float]) -> tuple[Finding, ...]:
        broken = _first(names, note[1:])
        latest = dict(zip(MEASURES, note[1 + len(names) :], strict=True))
        latest = self.ranks.mean({"loss": note[0], "broken": float(broken is not None), **latest})
        if latest.pop("broken") and broken is None:
            broken = "that of another rank"
        return self.judge(images, latest.pop("loss"), latest, broken)

    def judge(
        self, images: int, loss: float, latest: Mapping[str, float], broken: str | None = None
    ) -> tuple[Finding, ...]:
        """The problems, usually none, given a batch's loss and measurements; ``broken`` names a stage."""
        if broken is not None or not math.isfinite(loss):
            self.uneasy = True
            first = "" if broken is None else f"; the first value that is not finite is {broken}"
            text = f"the loss is {loss:.4g}{first}"
            return (Finding("non-finite loss", text, f"{SLOWER}; with bf16, try 32-true", True),)
        longer = max(1.0, self.batch_size / USUAL_BATCH)
        share = min(1.0, (images - self.last_images) / (longer * MEMORY_IMAGES))
        self.last_images, self.uneasy = images, False
        findings = []
        for name, value in latest.items():
            before = self.averages.get(name, value)
            self.averages[name] = before + share * (value - before)
        for sign in SIGNS:
            value = self.averages[sign.measure]
            shown = sign.is_on(value) or sign.is_on(latest[sign.measure])
            self.uneasy |= sign.fatal and shown and images >= longer * sign.usual_images
            limit = None if self.inversion else sign.invert
            on = sign.is_on(value) if limit is None else value < limit
            if images < longer * sign.grace_images or not on:
                self.on_since.pop(sign.name, None)
            elif images - self.on_since.setdefault(sign.name, images) < longer * PERSISTENCE_IMAGES:
                continue
            elif limit is not None:
                self.inversion = "due"
                del self.averages[sign.measure], self.on_since[sign.name]
            else:
                text, advice = sign.text.format(value=value), sign.advice.format(slower=SLOWER)
                findings.append(Finding(sign.name, text, advice, sign.fatal))
        return tuple(findings)


def _first(names: Sequence[str], finite: Sequence[float]) -> str | None:
    """The first name beside which stands no 1."""
    return next((name for name, one in zip(names, finite, strict=False) if not one), None)


@torch.no_grad()
def invert(model: Any, optimiser: torch.optim.Optimizer) -> None:
    """Press reliefs in instead of out, or the reverse; camera and light then show almost equal images.

    In the weak perspective of a small field of view both explain an image (the bas-relief ambiguity,
    Belhumeur et al. 1999). Signs of weights of last layers change, and of their gradients' averages.
    """
    for factor in model.factors:
        for name, weight in model.nets[factor.name].decoder.named_parameters():
            last = name.endswith(("last.weight", "linear.weight"))
            for row in INVERTED.get(factor.parameter, ()) if last else ():
                weight[row].neg_()
                if weight in optimiser.state:
                    optimiser.state[weight]["exp_avg"][row].neg_()


@torch.no_grad()
def measure(scene: Scene, ranges: SceneRanges) -> dict[str, Float[Tensor, ""]]:
    """The measurements of all signs, each a mean over the batch, on the scene's device.

    depth_at_bound, view_at_bound, light_at_bound: shares, 0..1. depth_spread: standard deviation of a depth
    map over its range. depth_roughness: mean step between neighbours over that deviation. bulge: how far the
    rim lies behind the middle, over the range; negative is hollow. shading_contrast: standard deviation of
    the shading in an image over its mean.
    """
    columns = ranges.border_columns(scene.depth.shape[-1])
    depth = scene.depth[..., columns:-columns] if columns else scene.depth
    low, high = ranges.depth_min, ranges.depth_max
    half, middle = (high - low) / 2, (high + low) / 2
    spread = depth.std(dim=(1, 2))
    steps = (depth.diff(dim=2).abs().mean(dim=(1, 2)) + depth.diff(dim=1).abs().mean(dim=(1, 2))) / 2
    y, x = (torch.linspace(-1, 1, size, device=depth.device) for size in depth.shape[1:])
    radius = (x.square() + y[:, None].square()).sqrt()
    ring, core = (radius > 0.7) & (radius < 1.0), radius < 0.4
    rim, centre = ((depth * part).sum(dim=(1, 2)) / part.sum() for part in (ring, core))
    rotation = scene.camera[:, :2].abs() / math.radians(ranges.rotation_deg)
    light = scene.light[:, 2:].abs() / math.radians(ranges.light_deg)
    shading = lambert_shading(normals_from_depth(scene.depth, ranges.fov_deg), scene.light).squeeze(1)
    return {
        "depth_at_bound": ((depth - middle).abs() > 0.97 * half).float().mean(),
        "depth_spread": (spread / (high - low)).mean(),
        "depth_roughness": (steps / spread.clamp(min=1e-6)).mean(),
        "bulge": (rim - centre).mean() / (high - low),
        "view_at_bound": (rotation > 0.95).any(dim=1).float().mean(),
        "light_at_bound": (light > 0.95).any(dim=1).float().mean(),
        "shading_contrast": (shading.std(dim=(1, 2)) / shading.mean(dim=(1, 2)).clamp(min=1e-6)).mean(),
    }
