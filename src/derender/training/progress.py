"""How far a run is, and how it ended."""

from dataclasses import dataclass
from pathlib import Path

from derender.training.watch import Finding


@dataclass(frozen=True)
class Progress:
    """Where a run stands, for a progress bar.

    Attributes:
        phase: "perceptual" while perceptual features are learnt, then "train", then "features" while what
            light and camera do to codes is measured.
        done, total: steps of the first phase, pictures of the others.
        images_per_second: since the run was started or resumed.
        terms: the latest losses by name.
        waiting: share of the time, since the run was started or resumed, spent waiting for pictures, 0..1.
    """

    phase: str
    done: int
    total: int
    images_per_second: float = 0.0
    terms: dict[str, float] | None = None
    waiting: float = 0.0


@dataclass(frozen=True)
class TrainResult:
    """How a run ended.

    Attributes:
        folder: the run folder; `derender.load` takes it.
        images: pictures seen.
        seconds: time spent training, resumed parts included.
        images_per_second: of this call.
        validation: last validation losses by name.
        stopped: "images", "minutes", "patience" or "collapse".
        findings: what the watcher saw last; empty when nothing was wrong.
        waiting: share of this call's time spent waiting for pictures, 0..1.
        model_images: pictures that the weights of the kept model had seen; None where that is not known.
    """

    folder: Path
    images: int
    seconds: float
    images_per_second: float
    validation: dict[str, float]
    stopped: str
    findings: tuple[Finding, ...]
    waiting: float = 0.0
    model_images: int | None = None
