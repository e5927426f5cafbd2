"""What `derender demo` does, step by step; every number it gives is measured on the way.

Training never sees the identities that are scored, and no label at all. The model that comes with derender is
scored on the same faces. Leaves out the page (see ``page``) and words at the terminal (see cli).
"""

import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from pydantic import Field

from derender.baselines.controls import pca_features, pixel_features, untrained_features, untrained_twin
from derender.data import GroundTruth, PictureSet
from derender.data.synthetic import SyntheticSet, faces
from derender.evaluation import (
    ClusterComparison,
    FactorResult,
    GeometryResult,
    ReconstructionResult,
    clusterings,
    compare_clusterings,
    evaluate_factors,
    evaluate_geometry,
    evaluate_reconstruction,
    mean_picture,
)
from derender.features import embed_pictures
from derender.model import Derenderer, load
from derender.report.run import decomposition_sheet
from derender.settings import Settings
from derender.training.config import TrainConfig, resolve
from derender.training.derender_task import train
from derender.training.task import Progress, TrainResult

Report = Callable[[str, int, int, str], None]
"""Called with (stage, done, total, note)."""

STAGES = (
    "generating faces",
    "learning perceptual features",
    "training",
    "scoring unseen faces",
    "writing the report",
)
FACTORS = ("geometry", "albedo")
BUNDLED = "rendered-faces-64"
"""The bundled model that has seen rendered faces only, as this demo's has."""


class DemoSettings(Settings):
    """How much the demo does; its time is set by ``images`` and bounded by ``minutes``."""

    train_pictures: int = Field(default=4_000, ge=20)
    test_pictures: int = Field(default=240, ge=16)
    images: int = Field(default=24_000, ge=2)  # pictures seen in training, repeats counted
    minutes: float = Field(default=4.3, gt=0)  # training stops here on a slow machine
    shown: int = Field(default=8, ge=1)  # unseen pictures on the page
    films: int = Field(default=4, ge=1)
    overrides: tuple[str, ...] = (  # of the preset `small`, as in --set
        "level_depth=true",
        "template_share=0.1",
        "release_share=0.3",
        "warmup_images=2000",
        "objective.self_features_steps=300",
    )


FULL = DemoSettings()
QUICK = DemoSettings(
    train_pictures=1_500,
    test_pictures=160,
    images=3_000,
    minutes=0.6,
    shown=6,
    films=3,
    overrides=("warmup_images=500", "objective.self_features_steps=60"),
)


@dataclass(frozen=True)
class DemoResult:
    """Everything the page shows.

    Attributes:
        folder: where the run folder and the page lie.
        settings, seed, config: what was asked for, and the training's resolved configuration.
        trained: how training ended.
        model: the trained model.
        bundled: the bundled model.
        bundled_geometry: its scores on the same pictures; None where they are not of its size.
        seen: pictures that training saw.
        truth: the unseen pictures with everything that made them.
        geometry, factors, reconstruction: scores on the unseen pictures.
        clustering: Ward clustering by identity for each kind of feature, the model's own first.
        clusters: (N,) the cluster of each unseen picture by the model's features.
        seconds: time of each stage.
    """

    folder: Path
    settings: DemoSettings
    seed: int
    config: TrainConfig
    trained: TrainResult
    model: Derenderer
    bundled: Derenderer
    bundled_geometry: GeometryResult | None
    seen: PictureSet
    truth: GroundTruth
    geometry: GeometryResult
    factors: FactorResult
    reconstruction: ReconstructionResult
    clustering: ClusterComparison
    clusters: np.ndarray
    seconds: dict[str, float]

    @property
    def identities(self) -> np.ndarray:
        """(N,) who is on each unseen picture."""
        return self.truth.labels["identity"]


def run_demo(
    out: str | Path, settings: DemoSettings = FULL, *, seed: int = 0, report: Report | None = None
) -> DemoResult:
    """Generate, train, score; the training's run folder is ``out/run``.

    Raises:
        FileExistsError: ``out`` is not empty.
        ValueError: training collapsed before it had a model to show.
    """
    out, tell = Path(out), report or _quiet
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise FileExistsError(f"{out} exists and is not empty: choose another --out")
    clock = _Clock()
    config = _training_config(settings, seed)
    size = config.model.network.image_size
    train_seed, test_seed = np.random.SeedSequence(seed).generate_state(2).tolist()
    total = settings.train_pictures + settings.test_pictures
    made = faces.generate(
        settings.train_pictures, size, train_seed, progress=lambda done, _: tell(STAGES[0], done, total, "")
    )
    seen = _as_pictures(made, "training faces")
    made = faces.generate(settings.test_pictures, size, test_seed)
    unseen, truth = _as_pictures(made, "unseen faces"), _as_truth(made)
    tell(STAGES[0], total, total, "")
    clock.lap(STAGES[0])

    def training_report(progress: Progress) -> None:
        if progress.phase == "train":
            tell(STAGES[2], progress.done, progress.total, f"{progress.images_per_second:.0f} pictures/s")
        elif progress.phase == "perceptual":
            clock.lap(STAGES[1])
            tell(STAGES[1], progress.done, progress.total, "")

    trained = train(config, seen, out / "run", sample_sheet=decomposition_sheet, progress=training_report)
    clock.lap(STAGES[2])
    if not (out / "run" / "model").exists():
        said = "; ".join(finding.text for finding in trained.findings) or trained.stopped
        raise ValueError(f"training collapsed before a model was saved ({said}): try another --seed")
    model = load(out / "run", device="cpu")

    tell(STAGES[3], 0, 4, "geometry")
    geometry = evaluate_geometry(model, truth, untrained=untrained_twin(model, seed))
    factors = evaluate_factors(model, truth)
    bundled = load(BUNDLED, device="cpu")
    bundled_geometry = evaluate_geometry(bundled, truth) if size == bundled.image_size else None
    tell(STAGES[3], 1, 4, "reconstruction")
    reconstruction = evaluate_reconstruction(model, unseen.images, mean=mean_picture(seen.images))
    tell(STAGES[3], 2, 4, "features")
    table = embed_pictures(model, unseen)
    components = min(64, len(seen) // 4)
    controls = {
        "untrained encoder": (untrained_features(model, unseen, seed=seed), FACTORS),
        f"PCA ({components})": (pca_features(unseen, components=components, fit_on=seen, seed=seed), None),
        "pixels": (pixel_features(unseen), None),
    }
    tell(STAGES[3], 3, 4, "clusters")
    tables = {" + ".join(FACTORS): (table, FACTORS), **controls}
    identities = truth.labels["identity"]
    clustering = compare_clusterings(
        {name: [rows.concatenate(chosen)] for name, (rows, chosen) in tables.items()},
        {"identity": identities}, controls=tuple(controls),
    )  # fmt: skip
    people = len(np.unique(identities))
    clusters = clusterings(table.concatenate(FACTORS), [people])[people]
    tell(STAGES[3], 4, 4, "")
    clock.lap(STAGES[3])
    return DemoResult(
        out, settings, seed, config, trained, model, bundled, bundled_geometry, seen, truth,
        geometry, factors, reconstruction, clustering, clusters, clock.seconds,
    )  # fmt: skip


def _training_config(settings: DemoSettings, seed: int) -> TrainConfig:
    fixed = {
        "images": settings.images,
        "minutes": settings.minutes,
        "validate_every": max(1, settings.images // 4),
        "sample_every": max(1, settings.images // 4),
        "checkpoint_every": max(1, settings.images // 2),
        "split": [0.95, 0.05, 0.0],  # the pictures that are scored are made apart, of other identities
        "seed": seed,
    }
    return resolve("small", settings.overrides, **fixed)


def _quiet(stage: str, done: int, total: int, note: str) -> None:
    pass


class _Clock:
    """How long each stage took."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}
        self._since = time.perf_counter()

    def lap(self, stage: str) -> None:
        """The time since the last lap belongs to ``stage``."""
        now = time.perf_counter()
        self.seconds[stage] = self.seconds.get(stage, 0.0) + now - self._since
        self._since = now


def _labels(made: SyntheticSet) -> dict[str, np.ndarray]:
    return {
        "identity": np.array([f"id{number:04d}" for number in made.identity]),
        "expression": np.asarray(made.expression),
    }


def _files(made: SyntheticSet) -> tuple[str, ...]:
    return tuple(f"face-{row:05d}" for row in range(len(made.images)))


def _as_pictures(made: SyntheticSet, source: str) -> PictureSet:
    return PictureSet(made.images, _files(made), _labels(made), layout="generated", source=source)


def _as_truth(made: SyntheticSet) -> GroundTruth:
    return GroundTruth(
        images=made.images,
        depth=made.depth,
        normal=made.normal,
        albedo=made.albedo.astype(np.float32) / 255,
        mask=made.mask,
        light=made.light,
        camera=made.camera,
        files=_files(made),
        labels=_labels(made),
    )
