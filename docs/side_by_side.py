"""Tables that show the same methods in several files side by side: each column a score, each row a method."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from paper_rows import kept

Reader = Callable[[Any], Iterator[list[str]]]


@dataclass(frozen=True)
class Score:
    """A column: one score of the part of a file at ``where``, its interval with ``intervals``."""

    file: str
    where: str
    key: str
    digits: int = 3
    by: float = 1
    intervals: bool = False

    def cell(self, names: Sequence[str], instead: Mapping[str, str]) -> str:
        """The score of the first of the rows that the file, or the one read instead of it, has."""
        if instead and self.file not in instead:
            return ""
        rows = kept(instead.get(self.file, self.file))
        for part in self.where.split():
            rows = rows[part]
        score = next((rows[name]["scores"].get(self.key) for name in names if name in rows), None)
        if score is None or score["value"] is None:
            return ""
        ends = [score[end] for end in ("value", "low", "high")]
        value, *interval = ("" if end is None else f"{self.by * end:.{self.digits}f}" for end in ends)
        return f"{value} ({'-'.join(interval)})" if self.intervals and all(interval) else value


@dataclass(frozen=True)
class Line:
    """A row of a table, by the names that it has in files; ``instead`` gives the file read for another."""

    title: str
    names: tuple[str, ...]
    instead: Mapping[str, str] = field(default_factory=dict)


def lines(*names: str, control: bool = True) -> list[Line]:
    """Rows under their own names."""
    note = " (control)" if control else ""
    return [Line(name + note, (name,)) for name in names]


def side_by_side(columns: Mapping[str, Score], rows: Sequence[Line]) -> tuple[str, Reader]:
    """Scores of the same methods in several files: the files, and the reader of the table."""

    def read(_: Any) -> Iterator[list[str]]:
        yield ["", *columns]
        for row in rows:
            yield [row.title, *(column.cell(row.names, row.instead) for column in columns.values())]

    files = [column.file for column in columns.values()]
    files += [file for row in rows for file in row.instead.values()]
    return " ".join(dict.fromkeys(files)), read


HEADS_FILE, FITTED = "generated/heads.json", "generated/heads-fitted.json"
AT_128, CARS = "generated/heads-128.json", "generated/cars-geometry.json"
GEOMETRY, TRUE = "intervals geometry", "intervals factors"
AVERAGE = ("average depth", "constant answer")
ALIGNED = "published/verification-aligned.json"
LFW, LFW_FITTED = "published/lfw.json", "published/lfw-fitted.json"
UTK_IMAGES, LFW_IMAGES = "published/reconstruction-utkface.json", "published/reconstruction-lfw.json"
BRIGHT, IDENTITY = "generated/brightness.json", "published/identity.json"
IDENTITY_128 = {IDENTITY: "published/identity-128.json"}
BINS = {"to 50°": ("<= 50", False), "to 77°": ("<= 77", True), "beyond": ("beyond", True)}
DESCRIPTORS = ("Gradientfaces", "HOG", "LBP")
PLAIN = ("untrained encoder", "PCA (64)", "pixels")
SIDE_BY_SIDE: dict[str, tuple[str, Reader]] = {
    "heads": side_by_side(
        {
            "SIDE x 100": Score(HEADS_FILE, GEOMETRY, "side", 3, 100, intervals=True),
            "normals, degrees": Score(HEADS_FILE, GEOMETRY, "mad_deg", 1),
            "albedo": Score(HEADS_FILE, TRUE, "albedo"),
            "lighting, degrees": Score(HEADS_FILE, TRUE, "light", 1),
            "viewpoint, degrees": Score(HEADS_FILE, TRUE, "camera", 1),
        },
        [
            Line("model, 20 steps per image", ("model",), {HEADS_FILE: FITTED}),
            Line("model", ("model",)),
            Line("average depth, constant answer (control)", AVERAGE),
            *lines("plane", "untrained model"),
            Line("`rendered-faces-128`, 128 pixels", ("model",), {HEADS_FILE: AT_128}),
            Line("average depth, 128 pixels (control)", AVERAGE, {HEADS_FILE: AT_128}),
            Line("`cars-64`, generated cars", ("model",), {HEADS_FILE: CARS}),
            Line("average depth of cars (control)", AVERAGE, {HEADS_FILE: CARS}),
        ],
    ),
    "people": side_by_side(
        {
            "generated people": Score("generated/people.json", "rows", "accuracy", intervals=True),
            "LFW": Score(LFW, "rows", "accuracy", intervals=True),
            "LFW, NMI": Score(LFW, "rows", "nmi"),
            "pairs of LFW": Score("published/verification.json", "rows", "accuracy", intervals=True),
            "classes of cars": Score("generated/cars-clusters.json", "rows", "accuracy"),
        },
        [
            *lines("geometry + albedo", control=False),
            Line("the same, 20 steps per image", ("geometry + albedo",), {LFW: LFW_FITTED}),
            *lines(
                *PLAIN, *(f"{name} with mirror image" for name in DESCRIPTORS), "LBP", "majority", "chance"
            ),
        ],
    ),
    "aligned": side_by_side(
        {
            "accuracy": Score(ALIGNED, "rows", "accuracy", intervals=True),
            "area under the curve": Score(ALIGNED, "rows", "auc", intervals=True),
        },
        [
            *lines("geometry + albedo", control=False),
            *lines(*PLAIN, *(f"{name} with mirror image" for name in DESCRIPTORS), "chance"),
        ],
    ),
    "identity": side_by_side(
        {name: Score(IDENTITY, "rows", key, intervals=wide) for name, (key, wide) in BINS.items()}
        | {"Ward": Score(IDENTITY, "rows", "ward accuracy")},
        [
            *lines("geometry + albedo", control=False),
            *lines(*PLAIN, *DESCRIPTORS, "chance"),
            Line("`faces-128`, 128 pixels", ("geometry + albedo",), IDENTITY_128),
            *(Line(f"{name}, 128 pixels (control)", (name,), IDENTITY_128) for name in DESCRIPTORS[:2]),
        ],
    ),
    "brightness": side_by_side(
        {
            "correlation": Score(BRIGHT, "brightness", "r"),
            "slope": Score(BRIGHT, "brightness", "slope", intervals=True),
            "error": Score(BRIGHT, "brightness", "error", 4),
            "UTKFace: share": Score("published/brightness-races.json", "share", "share", intervals=True),
        },
        [*lines("model", control=False), *lines("untrained model", "image as albedo", "constant answer")],
    ),
    "reconstruction": side_by_side(
        {
            f"{name}: {head}": Score(file, "intervals", key, digits)
            for name, file in (("UTKFace", UTK_IMAGES), ("LFW", LFW_IMAGES))
            for head, key, digits in (("L1", "l1", 4), ("SSIM", "ssim", 3))
        },
        [
            Line(
                "model, 20 steps per image",
                ("model",),
                {LFW_IMAGES: "published/reconstruction-lfw-fitted.json"},
            ),
            *lines("model", control=False),
            *lines("mean image", "PCA (64)", "untrained model"),
        ],
    ),
}
