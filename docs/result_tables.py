"""Tables of results as Markdown, from the files that commands and benchmarks wrote.

A table is one of ``FILES``, each read by a function of its own, or a file of benchmarks/results/tables with
its columns in it. There a row with ``hidden`` stays in the file.
"""

import json
import re
import textwrap
from collections.abc import Callable, Iterator, Mapping
from typing import Any

import paper_rows as theirs
import renderer_tables as drawn
import speed_tables as speed
from paper_rows import RESULTS, kept
from renderer_tables import spread


def table(name: str, keys: list[str] | None = None) -> str:
    """One table as Markdown, with a note: its file, and data that are not generated."""
    if name in FILES:
        files, read = FILES[name]
        first, *_ = names = files.split()
        head, *rows = read(json.loads((RESULTS / first).read_text()))
        lines = [head, ["---"] * len(head), *rows]
        note = ", ".join(f"`benchmarks/results/{one}`" for one in names)
    else:
        result = json.loads((RESULTS / "tables" / f"{name}.json").read_text())
        lines = [*body(result, keys or [column["key"] for column in result["columns"]])]
        note = f"`benchmarks/results/tables/{name}.json`"
        kept = {False: "from its owners", True: "not published"}
        sets = [
            f"{re.split(r' at |: |, ', x)[0]} ({kept['not published' in x]})" for x in result.get("needs", ())
        ]
        note += "; data: " + ", ".join(sets) if sets else ""
    shown = "\n".join("| " + " | ".join(map(str, line)) + " |" for line in lines)
    return f"{shown}\n\n{textwrap.fill(f'Source: {note}.', 118, break_on_hyphens=False)}\n"


def body(result: Mapping[str, Any], keys: list[str]) -> Iterator[list[str]]:
    """Rows of cells: the head, the rule, the rows; the best of each column is bold."""
    columns = {column["key"]: column for column in result["columns"]}
    rows = [row for row in result["rows"] if not row.get("hidden") and any(key in row for key in keys)]
    yield ["", *(columns[key]["head"] for key in keys)]
    yield ["---"] * (len(keys) + 1)
    best = {key: best_of(columns[key], [row[key] for row in rows if key in row]) for key in keys}
    for row in rows:
        cells = [cell(row.get(key), columns[key].get("digits", 0), best[key]) for key in keys]
        note = " (control)" if row.get("control") and "(control" not in row["name"] else ""
        yield [row["name"] + note, *cells]


def looked_up(reference: re.Match[str]) -> str:
    """``{table|row|column}`` in a cell: that number, as its own table shows it, without its interval."""
    name, row, key = reference[1].split("|")
    if name in FILES:
        head, *rows = FILES[name][1](kept(FILES[name][0].split()[0]))
        return next(cells for cells in rows if cells[0] == row)[head.index(key)].split(" (")[0]
    result = json.loads((RESULTS / "tables" / f"{name}.json").read_text())
    digits = next(column["digits"] for column in result["columns"] if column["key"] == key)
    return cell(value_of(next(one for one in result["rows"] if one["name"] == row)[key]), digits, None)


def value_of(entry: Any) -> float:
    return entry["value"] if isinstance(entry, dict) else entry


def best_of(column: Mapping[str, Any], entries: list[Any]) -> float | None:
    if "best" not in column or not entries:
        return None
    return (max if column["best"] == "high" else min)(map(value_of, entries))


def cell(entry: Any, digits: int, best: float | None) -> str:
    """A number with its interval or its standard deviation."""
    if entry is None:
        return ""
    if isinstance(entry, str):
        return re.sub(r"\{(.+?)\}", looked_up, entry)
    text = f"{value_of(entry):,.{digits}f}"
    text = f"**{text}**" if value_of(entry) == best else text
    if isinstance(entry, dict) and "low" in entry:
        return f"{text} ({entry['low']:.{digits}f}-{entry['high']:.{digits}f})"
    return f"{text} ± {entry['spread']:.{digits}f}" if isinstance(entry, dict) and "spread" in entry else text


def edits(which: str, angles: dict[str, str]) -> Callable[[Any], Iterator[list[str]]]:
    """PSNR and SSIM of edited photographs by angle."""
    names = {
        "derender": "derender, photograph's own pixels", "--detail model": "derender, `--detail model`",
        "the same scene, model's colours": "model's rendering of the same scene",
        "input": "unchanged photograph",
        "input, brightness of the truth": "unchanged, brightness of the truth",
        "input turned as a plane": "turned as a plane",
        "another person's ratio": "ratio of another person's photographs",
    }  # fmt: skip

    def read(result: Any) -> Iterator[list[str]]:
        yield ["PSNR, dB / SSIM", *angles.values()]
        for name, scores in result[which].items():
            shown = (scores.get(angle) for angle in angles)
            cells = [
                f"{psnr:.1f} / {ssim:.3f}" if psnr else "" for psnr, ssim in (s or (0, 0) for s in shown)
            ]
            yield [names.get(name, name), *cells]

    return read


def scored(columns: dict[str, tuple[str, float, int]], *where: str) -> Callable[[Any], Iterator[list[str]]]:
    """Rows of a protocol: for each head the score, what it is multiplied by, and its digits."""

    def read(result: Any) -> Iterator[list[str]]:
        for key in where:
            result = result[key]
        yield ["", *columns]
        for name, row in result.items():
            note = " (control)" if row["control"] else ""
            yield [name + note, *(shown(row["scores"].get(key), by, n) for key, by, n in columns.values())]

    def shown(score: Any, by: float, digits: int) -> str:
        if score is None or score["value"] is None:
            return ""
        value, low, high = (None if score[k] is None else by * score[k] for k in ("value", "low", "high"))
        text = f"{value:.{digits}f}"
        return text if low is None else f"{text} ({low:.{digits}f}-{high:.{digits}f})"

    return read


def with_steps(read: Callable[[Any], Iterator[list[str]]], file: str) -> Callable[[Any], Iterator[list[str]]]:
    """The rows of a table, above them its first row with 20 steps per image, from a file of its own."""

    def both(result: Any) -> Iterator[list[str]]:
        head, *rows = read(result)
        _, first, *_ = read(kept(file))
        yield from (head, [f"{first[0]}, 20 steps per image", *first[1:]], *rows)

    return both


def side_by_side(heads: Mapping[str, str], key: str) -> Callable[[Any], Iterator[list[str]]]:
    """One score of the same rows in several files of benchmarks/results/published, by the head of each."""

    def read(_: Any) -> Iterator[list[str]]:
        yield ["", *heads]
        files = [kept(f"published/{name}.json") for name in heads.values()]
        for name, row in files[0]["rows"].items():
            note = " (control)" if row["control"] else ""
            shown = (file["rows"][name]["scores"][key]["value"] for file in files)
            yield [name + note, *(f"{value:.3f}" for value in shown)]

    return read


def turned_and_lit(_: Any) -> Iterator[list[str]]:
    """Accuracy over growing angles: its mean, and at the largest."""
    yield ["", *(f"{what}: {where}" for what in ("yaw", "light") for where in ("area", "at the end"))]
    for what, file in ROBUST.items():
        curves = kept(file)["curves"]
        for name in ("geometry + albedo", "untrained encoder", "pixels"):
            cells = []
            for curve in (curves["yaw"], curves["light"]):
                scores = curve["accuracy"][name]["scores"]
                last = f"{curve['levels_deg'][-1]:g} deg"
                cells += [f"{scores[key]['value']:.3f}" for key in ("area", last)]
            note = "" if name == "geometry + albedo" else " (control)"
            yield [f"{what}: {name}{note}", *cells]


ROBUST = {
    "people": "generated/robustness-faces.json", "LFW": "published/robustness-lfw.json",
    "cars": "generated/robustness-cars.json",
}  # fmt: skip


def part(name: str, digits: Mapping[str, int]) -> Callable[[Any], Iterator[list[str]]]:
    """One part of a file as it is, its rows by name."""

    def read(result: Any) -> Iterator[list[str]]:
        yield ["", *digits]
        for row, scores in result[name].items():
            yield [row, *(f"{scores[key]:.{number}f}" for key, number in digits.items())]

    return read


def probed(result: Any) -> Iterator[list[str]]:
    """Balanced accuracy of each probe and number of labels."""
    names = [name for name in result["parts"][0]["rows"] if name not in ("majority", "chance")]
    yield ["probe, labels", *(name if name == names[0] else f"{name} (control)" for name in names)]
    for part in result["parts"]:
        scores = (part["rows"][name]["scores"]["balanced_accuracy"]["value"] for name in names)
        yield [f"{part['head']}, {part['labels']:,}", *(f"{score:.3f}" for score in scores)]


RUNGS = {
    "r0": "reconstruction alone", "r1": "+ LOOCC as in the paper", "r2": "+ template start",
    "r3": "+ cycle term", "r4": "+ stronger LOOCC", "r5": "+ whitening", "r6": "+ distillation",
    "r7": "+ 60 steps per image",
}  # fmt: skip


def averaged(result: Any, title: str, names: Mapping[str, str]) -> Iterator[list[str]]:
    """Means and deviations over the seeds that did not collapse, of each kind of run named."""
    keys = {"SIDE x 100": 2, "tracks nmi": 3, "LFW nmi": 3, "Yale B <= 50": 3}
    yield [title, "whole runs", *RUNG_TITLES]
    for rung, name in names.items():
        seeds = [row for row in result["rows"] if row["rung"] == rung]
        whole = [row for row in seeds if not row["collapsed"]]
        if seeds:
            values = {key: [row[key] for row in whole if key in row] for key in keys}
            cells = (spread(values[key], digits) if values[key] else "" for key, digits in keys.items())
            yield [name, f"{len(whole)} of {len(seeds)}", *cells]


def joint(result: Any) -> Iterator[list[str]]:
    names = {"factor": "one contrast for each factor", "joint": "codes side by side (Eq. 6)"}
    return averaged(result, "LOOCC", names)


def ladder(result: Any) -> Iterator[list[str]]:
    yield from averaged(result, "each row adds to the one above", RUNGS)
    controls = {file: kept(file)["rows"] for file in LADDER_CONTROLS}
    depth = kept("generated/heads.json")["intervals"]["geometry"]
    side = {name: f"{100 * depth[row]['scores']['side']['value']:.2f}" for name, row in LADDER_DEPTH.items()}
    yield ["average depth (control)", "", side["average depth"], "", "", ""]
    for name in ("untrained encoder", "PCA (64)", "pixels"):
        scores = (
            f"{controls[file][name]['scores'][key]['value']:.3f}" for file, key in LADDER_CONTROLS.items()
        )
        yield [f"{name} (control)", "", side.get(name, ""), *scores]


LADDER_CONTROLS = {"generated/people.json": "nmi", "published/lfw.json": "nmi", "identity_all.json": "<= 50"}
LADDER_DEPTH = {"average depth": "average depth", "untrained encoder": "untrained model"}
RUNG_TITLES = ("SIDE x 100", "tracks, NMI", "LFW, NMI", "Yale B to 50°")


def sharp(result: Any) -> Iterator[list[str]]:
    """Reconstructions at 128 pixels of models of two sizes."""
    first, *_ = result["rows"].values()
    yield ["", *first]
    for name, row in result["rows"].items():
        yield [name, *(f"{row[key]:.{4 if key == 'L1' else 3}f}" for key in first)]


def true_factors(result: Any) -> Iterator[list[str]]:
    model, untrained = (result["rows"][name][0]["truth"] for name in ("model", "untrained encoder"))
    yield ["true factor", *model["features"], "untrained, all"]
    for place, name in enumerate(model["factors"]):
        scores = (row[place] for row in (*model["score"], untrained["together"]))
        yield [name, *(f"{round(score, 2) + 0:.2f}" for score in scores)]


def disentangled(result: Any) -> Iterator[list[str]]:
    """Similarity between factors and the swap test, of the model and each control."""
    columns = ("Pearson per dimension", "CKA", "cross R2", "swap test, features", "swap test, decoded")
    yield ["", *columns]
    for name, (row, *_) in result["rows"].items():
        alike, swap = row["similarity"] or {}, row["swap"] or {}
        values = [
            (row["pearson"]["mean_per_dimension"], 3), (alike.get("mean_cka_unbiased"), 3),
            (alike.get("mean_cross_r2"), 3), (swap.get("ratio"), 2), (swap.get("ratio_parameters"), 2),
        ]  # fmt: skip
        label = name if name == "model" else f"{name} (control)"
        yield [label, *("" if value is None else f"{value:.{digits}f}" for value, digits in values)]


def swapped(result: Any) -> Iterator[list[str]]:
    """How far each feature moves towards its donor's where one factor was exchanged."""
    swap = result["rows"]["model"][0]["swap"]
    yield ["", *swap["factors"]]
    for name, row in zip(swap["factors"], swap["moved"], strict=True):
        yield [f"{name} exchanged", *(f"{value:.2f}" for value in row)]
    unexchanged = (f"{value:.2f}" for value in swap["unexchanged"])
    yield ["nothing exchanged, rendered and encoded again", *unexchanged]


def aligned(result: Any) -> Iterator[list[str]]:
    yield ["faces found", "recall", "precision", "eye error, mean", "90th percentile"]
    for group in ("pasted", "lfw crops"):
        for name, row in result[group].items():
            keys = ("recall", "precision", "eye_error_mean", "eye_error_90th")
            yield [f"{group}: {name}", *(f"{row[key]:.3f}" for key in keys)]


def framings(result: Any) -> Iterator[list[str]]:
    """Cosine of features between crops of one image, beside that of two people."""
    yield ["features of one image", "cosine, mean", "lowest pair, mean", "two people"]
    for name, row in result["framings"].items():
        keys = ("cosine_mean", "cosine_lowest_mean", "cosine_of_two_people")
        yield [name, *(f"{row[key]:.3f}" for key in keys)]


def angles(result: Any) -> Iterator[list[str]]:
    """Correlation, slope and error of each angle, beside the error of a constant answer."""
    yield ["angle", "r", "slope", "error, degrees", "constant answer, degrees"]
    for name in ("yaw", "pitch", "roll", "azimuth", "elevation"):
        if name in result:
            model = {key: score["value"] for key, score in result[name]["model"]["scores"].items()}
            control = result[name]["constant answer"]["scores"]["error"]["value"]
            cells = [f"{model[key]:.3f}" for key in ("r", "slope")] + [f"{model['error']:.1f}"]
            yield [name, *cells, f"{control:.1f}"]


BINS = {f"to {angle}°": (f"<= {angle}", 1, 3) for angle in (25, 50, 77)} | {"beyond": ("beyond", 1, 3)}
PSNR = {f"to {angle}°": (f"<= {angle}", 1, 1) for angle in (12, 25, 50, 77)} | {"beyond": ("beyond", 1, 1)}
PAIRS = {"accuracy": ("accuracy", 1, 3), "AUC": ("auc", 1, 3)}
CLUSTERS = {"accuracy": ("accuracy", 1, 3), "NMI": ("nmi", 1, 3), "ARI": ("ari", 1, 3)}
DEPTH = {"SIDE x 100": ("side", 100, 3), "MAD, degrees": ("mad_deg", 1, 1)}
FACTORS = {
    "albedo": ("albedo", 1, 3),
    "lighting, degrees": ("light", 1, 1),
    "viewpoint, degrees": ("camera", 1, 1),
}
LARGE = {"CelebA, 40 attributes": "celeba", "UTKFace, 5 races": "races"}
IMAGES = {"L1": ("l1", 1, 4), "PSNR, dB": ("psnr_db", 1, 2), "SSIM": ("ssim", 1, 3)}
GEOMETRY, TRUE, FITTED = ("intervals", "geometry"), ("intervals", "factors"), "generated/heads-fitted.json"
BRIGHTNESS = {"correlation": ("r", 1, 3), "slope": ("slope", 1, 3), "error": ("error", 1, 4)}
LIGHTS = {f"up to {angle}": f"up to {angle}°" for angle in (12, 25, 50, 77)} | {"beyond": "beyond 77°"}
HEADS = {f"light {angle}": f"light {angle}°" for angle in (25, 45, 65)} | {
    "view 15": "view 15°",
    "view 30": "view 30°",
}
FILES: dict[str, tuple[str, Callable[[Any], Iterator[list[str]]]]] = {  # files, the first for the reader
    "edits-yale": ("photo_edits.json", edits("yale", LIGHTS)),
    "edits-heads": ("photo_edits.json", edits("generated heads", HEADS)),
    "training-step": ("training_step.json", speed.training_step),
    "rasterize": ("rasterize.json", speed.rasterize),
    "peers": ("rasterize_peers.json", speed.peers),
    "reading": ("reading.json", speed.reading),
    "memory": ("embedding_memory.json", speed.memory),
    "step-memory": ("step_memory.json", speed.step_memory),
    "million": ("clustering_million.json", speed.million),
    "true-factors": ("true-factors.json", true_factors),
    "disentanglement-generated": ("true-factors.json", disentangled),
    "swap-matrix-generated": ("true-factors.json", swapped),
    "bench": ("bench.json", speed.shares),
    "step-profile": ("step_profile.json", speed.profiled),
    "compiled-step": ("compiled_step.json", speed.compiled),
    "gpu-steps": ("gpu.json", speed.gpu_steps),
    "gpu-agreement": ("gpu.json", speed.gpu_agreement),
    "fitting": ("fitting.json", speed.fitting),
    "disentangling": ("fitting.json", speed.disentangling),
    "heads-generated": (f"generated/heads.json {FITTED}", with_steps(scored(DEPTH, *GEOMETRY), FITTED)),
    "faces-128": ("sharpness.json", sharp),
    "heads-128": ("generated/heads-128.json", scored(DEPTH, *GEOMETRY)),
    "factors-generated": (f"generated/heads.json {FITTED}", with_steps(scored(FACTORS, *TRUE), FITTED)),
    "people-lfw": ("published/lfw.json", scored(CLUSTERS, "rows")),
    "people-lfw-fitted": ("published/lfw-fitted.json", scored(CLUSTERS, "rows")),
    "people-lfw-finch": ("published/lfw-finch.json", scored(CLUSTERS, "rows")),
    "disentanglement-lfw": ("published/disentanglement-lfw.json", disentangled),
    "reconstruction-utkface": ("published/reconstruction-utkface.json", scored(IMAGES, "intervals")),
    "reconstruction-lfw": (
        "published/reconstruction-lfw.json published/reconstruction-lfw-fitted.json",
        with_steps(scored(IMAGES, "intervals"), "published/reconstruction-lfw-fitted.json"),
    ),
    "large-classes": ("published/celeba.json published/races.json", side_by_side(LARGE, "accuracy")),
    "celeba-labels": ("published/celeba-labels.json", probed),
    "robustness-generated": (" ".join(ROBUST.values()), turned_and_lit),
    "paper-clustering": (
        " ".join(f"published/compare-{one}.json" for one in theirs.PARTS),
        theirs.beside_the_paper,
    ),
    "paper-linear": ("published/compare-linear.json", theirs.few_labels),
    "demo-depth": ("demo.json", part("geometry", {"SIDE x 100": 3, "MAD": 1})),
    "demo-people": ("demo.json", part("clustering", {"accuracy": 3, "NMI": 3})),
    "demo-images": ("demo.json", part("reconstruction", {"L1": 4, "PSNR": 2, "SSIM": 3})),
    "ladder": (" ".join(("ladder.json generated/heads.json", *LADDER_CONTROLS)), ladder),
    "loocc-joint": ("loocc-joint.json", joint),
    "paper-gpu": ("paper-gpu.json", theirs.preset),
    "brightness-generated": ("generated/brightness.json", scored(BRIGHTNESS, "brightness")),
    "identity": ("identity.json", scored(BINS | {"Ward": ("ward accuracy", 1, 3)}, "rows")),
    "verification": ("verification.json", scored(PAIRS, "rows")),
    "pose": ("pose.json", angles),
    "light": ("light.json", angles),
    "light-optimised": ("light-optimised.json", angles),
    "relighting": ("relighting.json", scored(PSNR, "psnr")),
    "renderers": ("renderers_fit.json", drawn.renderers),
    "renderers-speed": ("renderers_speed.json", drawn.renderer_speed),
    "renderers-train": ("renderers_train.json", drawn.renderers_trained),
    "renderers-clear": ("renderers_train.json", lambda result: drawn.renderers_trained(result, clear=True)),
    "renderers-numbers": ("renderers_train.json", drawn.effect_numbers),
    "renderers-yale": ("renderers_yaleb.json", drawn.renderers_yale),
    "table-million": ("table_million.json", speed.million_rows),
    "view": ("view.json", speed.page_speed),
    "align": ("align.json", aligned),
    "framings": ("align.json", framings),
    "brightness-races": ("brightness-races.json", scored({"share of brightness": ("share", 1, 3)}, "share")),
    "people-generated": ("generated/people.json", scored(CLUSTERS, "rows")),
    "cars-generated": ("generated/cars-clusters.json", scored(CLUSTERS, "rows")),
    "cars-depth-generated": ("generated/cars-geometry.json", scored(DEPTH, "intervals", "geometry")),
}
