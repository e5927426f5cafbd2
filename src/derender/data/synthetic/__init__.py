"""Built-in images with exact ground truth: procedural generators that need no download.

``faces.generate`` and ``cars.generate`` make them, ``write`` saves them in the layout of the rendered data
sets. ``write_benchmark`` writes the fixed sets of published scores, which anyone can make again.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from derender.data.stream import Progress
from derender.data.synthetic import cars, faces
from derender.data.synthetic.morphable import MorphableFaces
from derender.data.synthetic.settings import (
    CAR_LIGHTS,
    CAR_VIEWS,
    LIGHTS,
    VIEWS,
    CarSettings,
    CarViewSettings,
    FaceSettings,
    LightSettings,
    ViewSettings,
    named_settings,
    numbers_of,
)
from derender.data.synthetic.synthetic_set import SyntheticSet, require_empty, write
from derender.storage.atomic import atomic_folder

__all__ = [
    "CAR_LIGHTS", "CAR_VIEWS", "KINDS", "LIGHTS", "PARTS", "VIEWS", "CarSettings", "CarViewSettings",
    "FaceSettings", "LightSettings", "MorphableFaces", "SyntheticSet", "ViewSettings", "cars", "faces",
    "named_settings", "require_empty", "write", "write_benchmark", "write_generated",
]  # fmt: skip


@dataclass(frozen=True)
class BenchmarkPart:
    """One folder of a benchmark: its seed, its size, and how its settings differ from the usual ones."""

    seed: int
    count: int
    ranges: str = "usual"
    overrides: Sequence[str] = ()
    truth: bool = False


KINDS: dict[str, tuple] = {"faces": (faces.generate, FaceSettings), "cars": (cars.generate, CarSettings)}

PARTS = {
    kind: {name: BenchmarkPart(**row) for name, row in numbers_of(kind)["benchmark"].items()}
    for kind in KINDS
}  # by kind and folder


def write_generated(
    kind: str, folder: Path | str, count: int, image_size: int = 64, seed: int = 0,
    settings: FaceSettings | CarSettings | None = None, truth: bool = True,
    progress: Progress | None = None, model: Path | str | None = None,
) -> SyntheticSet:  # fmt: skip
    """Generate "faces" or "cars" into a new folder, which appears when it is complete; gives the set, too.

    Args:
        truth: write depth, normals, albedo, masks and parts beside the images.
        progress: called with (images done, ``count``); one that is drawn is half done, until it is written.
        model: file of a morphable model of faces to use; None: the built-in one.

    Raises:
        FileExistsError: the folder holds something.
        ValueError: a number that no set can have.
    """
    require_empty(Path(folder))
    more = {} if model is None else {"model": model}
    report = progress or (lambda *_: None)
    made = KINDS[kind][0](count, image_size, seed, settings, lambda done, _: report(done // 2, count), **more)
    write(made, folder, truth, lambda done, _: report((count + done) // 2, count))
    return made


def write_benchmark(
    kind: str, folder: Path | str, image_size: int = 64, progress: Progress | None = None
) -> Path:
    """Generate the benchmark of "faces" or "cars" in a new folder, which appears when it is complete.

    Args:
        image_size: 16 to 1024 pixels; scores are published at 64.
        progress: called with the number of images generated so far, and that of all.

    Raises:
        FileExistsError: the folder holds something.
        ValueError: a size that no set can have.
    """
    require_empty(folder := Path(folder))
    total, before = sum(part.count for part in PARTS[kind].values()), 0
    with atomic_folder(folder) as temporary:
        for name, part in PARTS[kind].items():
            chosen = named_settings(KINDS[kind][1], part.ranges, part.ranges, part.overrides)
            so_far = None if progress is None else lambda done, _, at=before: progress(at + done, total)
            size, seed = image_size, part.seed
            write_generated(kind, temporary / name, part.count, size, seed, chosen, part.truth, so_far)
            before += part.count
    return folder
