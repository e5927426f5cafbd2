"""Tables of trainings that differ in one setting, or in their seed alone."""

from collections.abc import Iterator
from typing import Any

from paper_rows import kept
from renderer_tables import spread

RUNGS = {
    "r0": "reconstruction alone", "r1": "+ LOOCC as in the paper", "r2": "+ template start",
    "r3": "+ cycle term", "r4": "+ stronger LOOCC", "r5": "+ whitening", "r6": "+ distillation",
    "r7": "+ 60 steps per image",
}  # fmt: skip
LADDER_CONTROLS = {
    "generated/people.json": "nmi", "published/lfw.json": "nmi", "published/identity-all.json": "<= 50",
}  # fmt: skip
LADDER_DEPTH = {"PCA (64)": "average depth", "untrained encoder": "untrained model"}


def ladder(result: Any) -> Iterator[list[str]]:
    """Means and deviations over the seeds that did not collapse, then controls."""
    keys = {"SIDE x 100": 2, "tracks nmi": 3, "LFW nmi": 3, "Yale B <= 50": 3}
    scores = ("SIDE x 100", "tracks, NMI", "LFW, NMI", "Yale B, 25 to 50°")
    yield ["each row adds to the one above", "whole runs", *scores]
    for rung, name in RUNGS.items():
        seeds = [row for row in result["rows"] if row["rung"] == rung]
        whole = [row for row in seeds if not row["collapsed"]]
        values = {key: [row[key] for row in whole if key in row] for key in keys}
        cells = (spread(values[key], digits) if values[key] else "" for key, digits in keys.items())
        yield [name, f"{len(whole)} of {len(seeds)}", *cells]
    controls = {file: kept(file)["rows"] for file in LADDER_CONTROLS}
    depth = kept("generated/heads.json")["intervals"]["geometry"]
    side = {name: f"{100 * depth[row]['scores']['side']['value']:.2f}" for name, row in LADDER_DEPTH.items()}
    for name in ("untrained encoder", "PCA (64)", "pixels", "Gradientfaces"):
        scores = (
            f"{controls[file][name]['scores'][key]['value']:.3f}" for file, key in LADDER_CONTROLS.items()
        )
        shown = f"average depth; {name}" if name == "PCA (64)" else name
        yield [f"{shown} (control)", "", side.get(name, ""), *scores]


SEEDED = {
    "31 people of LFW, Ward accuracy": ("published/lfw.json", "accuracy", "LFW accuracy"),
    "31 people of LFW, NMI": ("published/lfw.json", "nmi", "LFW nmi"),
    "pairs of LFW, accuracy": ("published/verification.json", "accuracy", "pairs accuracy"),
    "pairs of LFW, area under the curve": ("published/verification.json", "auc", "pairs auc"),
    "Yale B, light from 25 to 50 degrees": ("published/identity.json", "<= 50", "Yale B <= 50"),
    "Yale B, 50 to 77 degrees": ("published/identity.json", "<= 77", "Yale B <= 77"),
    "Yale B, beyond": ("published/identity.json", "beyond", "Yale B beyond"),
    "Yale B, Ward accuracy": ("published/identity.json", "ward accuracy", "Yale B ward accuracy"),
    "all 18 people, 25 to 50 degrees": ("published/identity-all.json", "<= 50", "Yale B, all <= 50"),
    "all 18 people, 50 to 77 degrees": ("published/identity-all.json", "<= 77", "Yale B, all <= 77"),
    "all 18 people, beyond": ("published/identity-all.json", "beyond", "Yale B, all beyond"),
    "all 18 people, Ward": ("published/identity-all.json", "ward accuracy", "Yale B, all ward accuracy"),
}
SEEDED_FILES = tuple(dict.fromkeys(file for file, *_ in SEEDED.values()))


def seeds(result: Any) -> Iterator[list[str]]:
    """Means and deviations over trainings that differ in their seed, the released model, the best control."""
    yield ["", f"{len(result['rows'])} seeds", "`faces-64`", "best control"]
    for name, (file, key, column) in SEEDED.items():
        rows = kept(file)["rows"]
        released = rows["geometry + albedo"]["scores"][key]["value"]
        control = max(row["scores"][key]["value"] for row in rows.values() if row["control"])
        yield [name, spread([row[column] for row in result["rows"]], 3), f"{released:.3f}", f"{control:.3f}"]


RENDERED = {
    "side": ("SIDE x 100", 100, 3), "mad_deg": ("normals, degrees", 1, 1), "albedo": ("albedo", 1, 3),
    "light": ("lighting, degrees", 1, 1), "camera": ("viewpoint, degrees", 1, 1),
    "accuracy": ("accuracy", 1, 3),
}  # fmt: skip


def seeds_rendered(result: Any) -> Iterator[list[str]]:
    """Means and deviations over trainings of rendered objects, the released model, the best control."""
    yield ["", f"{len(result['rows'])} seeds", "released", "best control"]
    for column, released in result["released"].items():
        images, _, key = column.partition(" ")
        if key in RENDERED:
            name, times, digits = RENDERED[key]
            values = spread([times * row[column] for row in result["rows"]], digits)
            others = (f"{times * value:.{digits}f}" for value in (released, result["controls"][column]))
            yield [f"{images}: {name}", values, *others]
