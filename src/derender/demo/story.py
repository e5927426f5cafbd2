"""The steps of `derender demo`: generate, train, score; every number it gives is measured on the way.

Its first page shows photographs edited by a bundled model: generated portraits, or those of a user's folder
in which a face is found. Training never sees the identities that are scored, and no label at all. The bundled
model is scored on the same faces. Leaves out the last page (see ``page``) and output at the terminal.
"""

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import UInt8
from PIL import Image
from pydantic import Field

from derender.baselines.controls import untrained_twin
from derender.data import GroundTruth, ImageSet, read_images
from derender.data.synthetic import LIGHTS, VIEWS, FaceSettings, LightSettings, faces, require_empty
from derender.evaluation import cluster, clusterings
from derender.evaluation.pixels import ReconstructionResult, evaluate_reconstruction, mean_image
from derender.evaluation.scenes import optimised
from derender.evaluation.score_table import ScoreTable
from derender.evaluation.truth import FactorResult, GeometryResult, evaluate_factors, evaluate_geometry
from derender.features import embed_image_set
from derender.learn import train
from derender.model import Derenderer, load
from derender.photo import find_faces, open_photograph
from derender.postprocess.fitting import STEPS
from derender.report.colours import image_bytes
from derender.report.page import Page
from derender.report.run import run_evidence, run_page
from derender.settings import Settings
from derender.training.config import TrainConfig, resolve
from derender.training.task import Progress, TrainResult

EDITOR = "faces-64"  # the bundled model that knows photographs
SHOWN, EXAMINED, REFRESH_S, SEED = 4, 12, 10, 7


Report = Callable[[str, int, int, str], None]  # called with (stage, done, total, note)

STAGES = ("generating faces", "learning perceptual features", "training", "estimating features", "scoring")


class LivePage:
    """The page of a running demo in a new folder: the opening, progress, the newest samples; it reloads."""

    def __init__(self, out: Path, images: str | Path | None, side: int, report: Report):
        require_empty(out)
        report("editing photographs", 0, 1, "")
        self.file, self.samples = out / "report.html", out / "run" / "samples"
        self.opening = opening(images, side)
        self.updated = float("-inf")
        self.update("Training begins")

    def update(self, status: str) -> None:
        """Write the page, at most every few seconds."""
        if time.monotonic() - self.updated < REFRESH_S:
            return
        samples = sorted(self.samples.glob("*.png"))
        sample = samples[-1].read_bytes() if samples else None
        values = {"opening": self.opening, "status": status, "sample": sample}
        lead = "Depth, lighting and viewpoint are predicted from one image each, without labels."
        Page("demo_opening.html", "Images decomposed", lead, values, refresh_s=REFRESH_S).write(self.file)
        self.updated = time.monotonic()

    def follow(self, progress: Progress, report: Report) -> None:
        """Report what training tells, at the terminal and on the page."""
        stages = {"perceptual": STAGES[1], "train": STAGES[2], "features": STAGES[3]}
        note, stage = "", stages.get(progress.phase, "reading images")
        if progress.phase == "train":
            note = f"{progress.images_per_second:.0f} images/s"
            self.update(f"{progress.done:,} of {progress.total:,} images seen")
        report(stage, progress.done, progress.total, note)


def opening(address: str | Path | None = None, side: int = 512) -> dict[str, Any]:
    """Photographs relit, rotated, in the light of another, for a page; generated ones if no face is found."""
    shown, source = [], "your photographs"
    if address is not None:
        read = read_images(address, side, limit=EXAMINED).images.transpose(0, 2, 3, 1)
        shown = [photo for _, photo in zip(range(SHOWN), filter(find_faces, read), strict=False)]
    if not shown:
        shown, source = portraits(side), "generated portraits, which show no real person"
    model = load(EDITOR)
    photos = [open_photograph(photo, model) for photo in shown]
    pairs = zip(photos, [*photos[1:], photos[0]], strict=True)
    columns = {
        "input": shown,
        "lit from the left, 60°": [photo.relit(60) for photo in photos],
        "lit from the right, 60°": [photo.relit(-60) for photo in photos],
        "rotated by 15°": [photo.rotated(15) for photo in photos],
        "in the light of the next": [photo.edited(light=donor.scene.light) for photo, donor in pairs],
    }

    def jpeg(photo: UInt8[np.ndarray, "h w 3"]) -> bytes:
        return image_bytes(Image.fromarray(np.ascontiguousarray(photo)), "JPEG", quality=88)

    files = {name: [jpeg(one) for one in edited] for name, edited in columns.items()}
    names = [f"photograph {row + 1}" for row in range(len(shown))]
    return {"columns": files, "names": names, "source": source}


def portraits(side: int) -> list[UInt8[np.ndarray, "h w 3"]]:
    """Generated heads of different people, lit from the front and, the last, from the side."""
    aside = LightSettings(yaw_deg=(32, 32), pitch_deg=(20, 20), ambient=(0.3, 0.3), diffuse=(0.55, 0.55))
    lights = [LIGHTS["frontal"]] * (SHOWN - 1) + [aside]
    how = {"pictures_per_identity": 1, "expressions": {"neutral": 1.0}, "backgrounds": ("plain",)}
    settings = [FaceSettings(light=light, view=VIEWS["frontal"], **how) for light in lights]
    made = [faces.generate(1, side, SEED + row, settings=one) for row, one in enumerate(settings)]
    return [one.images[0].transpose(1, 2, 0) for one in made]


BUNDLED = "rendered-faces-64"  # the bundled model that has seen rendered faces only, as this demo's has


class DemoSettings(Settings):
    """Size of the demo; its time is set by ``images`` and bounded by ``minutes``."""

    train_pictures: int = Field(default=4_000, ge=20)
    test_pictures: int = Field(default=240, ge=16)
    images: int = Field(default=20_000, ge=2)  # images seen in training, repeats counted
    minutes: float = Field(default=5, gt=0)  # training stops here on a slow machine
    fit_steps: int = Field(default=2 * STEPS, ge=0)  # of each unseen scene before its depth is scored
    shown: int = Field(default=8, ge=1)  # unseen images on the page
    films: int = Field(default=4, ge=1)
    portrait_px: int = Field(default=512, ge=64)  # of the photographs that open the page
    overrides: tuple[str, ...] = (  # of the preset `small`, as in --set
        "level_depth=true",
        "template_share=0.1",
        "release_share=0.3",
        "warmup_images=2000",
        "objective.self_features_steps=300",
        "objective.raised_weight=0",  # early, raised surfaces are too round from top to bottom
        "whitening.pictures=1000",
        "fitting.examples=1000",
    )

    def training(self, seed: int, split: tuple[float, float, float] = (0.95, 0.05, 0.0)) -> TrainConfig:
        """The configuration of the demo's training run; scored faces are made apart, of other identities."""
        quarter, half = max(1, self.images // 4), max(1, self.images // 2)
        return resolve(
            "small", self.overrides, images=self.images, minutes=self.minutes, validate_every=quarter,
            sample_every=quarter, checkpoint_every=half, split=list(split), seed=seed,
        )  # fmt: skip


FULL = DemoSettings()
QUICK = DemoSettings(
    train_pictures=1_000, test_pictures=120, images=1_600, minutes=0.4, fit_steps=0, shown=6, films=3,
    overrides=(
        "warmup_images=400", "objective.self_features_steps=60", "whitening.pictures=200",
        "fitting.examples=200",
    ),
)  # fmt: skip


@dataclass(frozen=True)
class DemoResult:
    """The content of the page; scores are of the unseen images."""

    settings: DemoSettings
    seed: int
    config: TrainConfig  # the training's resolved configuration
    trained: TrainResult
    model: Derenderer
    bundled: Derenderer
    opening: dict[str, Any]  # photographs edited by a bundled model
    seen: ImageSet  # images of the training
    truth: GroundTruth  # the unseen images with everything that made them
    # of scenes optimised for ``settings.fit_steps``; ``geometry_beside`` without steps, and by the bundled
    # model where the images have its size
    geometry: GeometryResult
    geometry_beside: dict[str, GeometryResult]
    factors: FactorResult
    reconstruction: ReconstructionResult
    clustering: ScoreTable  # Ward clusters by identity, of features and controls
    clusters: np.ndarray  # (N,) the cluster of each unseen image by the model's features
    seconds: dict[str, float]  # time of each stage

    @property
    def identities(self) -> np.ndarray:
        """(N,) the person on each unseen image."""
        return self.truth.labels["identity"]


def run_demo(
    out: str | Path, settings: DemoSettings = FULL, *, seed: int = 0,
    report: Report = lambda stage, done, total, note: None,
    opened: Callable[[Path], object] = lambda page: None,
) -> DemoResult:  # fmt: skip
    """Generate, train, score; the training's run folder is ``out/run``.

    ``opened`` is called with ``out/report.html`` once that shows photographs, before anything is trained.

    Raises:
        FileExistsError: ``out`` is not empty.
        ValueError: training collapsed before it saved a model.
    """
    run = Path(out) / "run"
    live = LivePage(Path(out), None, settings.portrait_px, report)
    opened(live.file)
    seconds: dict[str, float] = {}
    began, now = time.perf_counter(), STAGES[0]

    def at(stage: str, done: int, total: int, note: str = "") -> None:
        """Report; the time since the last report belongs to its stage."""
        nonlocal began, now
        seconds[now] = seconds.get(now, 0.0) + time.perf_counter() - began
        began, now = time.perf_counter(), stage
        report(stage, done, total, note)

    config = settings.training(seed)
    size = config.model.network.image_size
    train_seed, test_seed = np.random.SeedSequence(seed).generate_state(2).tolist()
    count = settings.train_pictures
    seen, _ = _generated(count, size, train_seed, lambda done, _: at(STAGES[0], done, count))
    unseen, truth = _generated(settings.test_pictures, size, test_seed)
    trained = train(seen, out=run, config=config, page=False, progress=partial(live.follow, report=at))
    if not (run / "model").exists():
        reason = "; ".join(finding.text for finding in trained.findings) or trained.stopped
        raise ValueError(f"training collapsed before a model was saved ({reason}): try another --seed")
    model, bundled = load(run, device="cpu"), load(BUNDLED, device="cpu")
    at(STAGES[4], 0, 4, "geometry")
    fitted = optimised(model, settings.fit_steps)
    geometry = evaluate_geometry(fitted, truth, untrained=untrained_twin(model, seed))
    beside = {"this run, feed-forward": model} if settings.fit_steps else {}
    beside |= {BUNDLED: bundled} if size == bundled.image_size else {}
    geometry_beside = {name: evaluate_geometry(one, truth) for name, one in beside.items()}
    factors = evaluate_factors(model, truth)
    at(STAGES[4], 1, 4, "reconstruction")
    reconstruction = evaluate_reconstruction(
        model, unseen.images, mean=mean_image(seen.images), components_of=seen.images[:4096]
    )
    at(STAGES[4], 2, 4, "features")
    scores = cluster(model, "identity", images=unseen, seed=seed, cache="none")
    at(STAGES[4], 3, 4, "clusters")
    features = embed_image_set(model, unseen).concatenate(("geometry", "albedo"))
    people = len(np.unique(truth.labels["identity"]))
    clusters = clusterings(features, [people])[people]
    at(STAGES[4], 4, 4)
    return DemoResult(
        settings, seed, config, trained, model, bundled, live.opening, seen, truth,
        geometry, geometry_beside, factors, reconstruction, scores.tables[0], clusters, seconds,
    )  # fmt: skip


def run_own_demo(
    images: str | Path, out: str | Path, settings: DemoSettings = FULL, *, seed: int = 0,
    report: Report = lambda stage, done, total, note: None,
    opened: Callable[[Path], object] = lambda page: None,
) -> Path:  # fmt: skip
    """The same with images of the user's own: edit, train, decompose held-out ones. Gives the page.

    What needs true depth or names of people is left out. ``out`` and ``opened`` are as in `run_demo`.
    """
    run = Path(out) / "run"
    live = LivePage(Path(out), images, settings.portrait_px, report)
    opened(live.file)
    own = ("warmup", "objective", "image", "batch", "whitening", "fitting")
    plain = tuple(one for one in settings.overrides if one.startswith(own))
    config = settings.model_copy(update={"overrides": plain}).training(seed, split=(0.8, 0.1, 0.1))
    train(images, out=run, config=config, page=False, progress=partial(live.follow, report=report))
    report(STAGES[4], 0, 1, "")
    page = run_page(run, run_evidence(run, images))
    values = {**page.values, "opening": live.opening}
    page = replace(page, template="demo_own.html", title="Your images decomposed", values=values)
    return page.write(live.file)


def _generated(
    count: int, size: int, seed: int, progress: Callable[[int, int], None] | None = None
) -> tuple[ImageSet, GroundTruth]:
    """Generated faces as a set of images, and with everything that made them."""
    made = faces.generate(count, size, seed, progress=progress)
    files = tuple(f"face-{row:05d}" for row in range(count))
    people = np.array([f"id{number:04d}" for number in made.identity])
    labels = {"identity": people, "expression": np.asarray(made.expression)}
    same = ("images", "depth", "normal", "mask", "light", "camera")
    known = {name: getattr(made, name) for name in same}
    truth = GroundTruth(**known, albedo=made.albedo.astype(np.float32) / 255, files=files, labels=labels)
    return ImageSet(made.images, files, labels, layout="generated", source="generated faces"), truth
