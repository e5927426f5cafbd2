"""Tables of results as Markdown, from the files that commands and benchmarks wrote.

A table is one of ``FILES``: the files it shows, under benchmarks/results, the first for its reader.
"""

import re
import textwrap
from collections.abc import Iterator, Mapping, Sequence
from statistics import fmean
from typing import Any

import paper_rows as theirs
import renderer_tables as drawn
import speed_tables as speed
import training_tables as trained
from paper_rows import kept
from side_by_side import CARS, HEADS_FILE, LFW, SIDE_BY_SIDE, Reader

from derender.evaluation.paper_tables import SEGMENTATION


def table(name: str) -> str:
    """One table as Markdown, with a note that names its files."""
    files, _ = FILES[name]
    head, *rows = body(name)
    lines = ["| " + " | ".join(line) + " |" for line in (head, *rows)]
    note = ", ".join(f"`benchmarks/results/{file}`" for file in files.split())
    shown = "\n".join([lines[0], "|" + "---|" * len(head), *lines[1:]])
    return f"{shown}\n\n{textwrap.fill(f'Source: {note}.', 118, break_on_hyphens=False)}\n"


def body(name: str) -> list[list[str]]:
    """The rows of a table, the head first."""
    files, read = FILES[name]
    return list(read(kept(files.split()[0])))


def looked_up(reference: re.Match[str]) -> str:
    """``{table|row|column}``: that number, as its own table shows it, without its interval."""
    name, row, column = reference[1].split("|")
    head, *rows = body(name)
    return next(cells for cells in rows if cells[0] == row)[head.index(column)].split(" ")[0]


def summary(_: Any) -> Iterator[list[str]]:
    """Each result beside its strongest control, every number looked up in the table of its own."""
    yield ["", "derender", "strongest control", "lost to it"]
    for row in SUMMARY:
        yield [re.sub(r"\{(.+?)\}", looked_up, cell) for cell in row]


SUMMARY = (
    (
        "depth of generated heads, SIDE x 100 (low)",
        "{heads|model|SIDE x 100}",
        "average depth {heads|average depth, constant answer (control)|SIDE x 100}",
        "nothing",
    ),
    (
        "12 generated people, unseen light and view, 20 steps",
        "{people|geometry + albedo|generated people}",
        "HOG with mirror image {people|HOG with mirror image (control)|generated people}",
        "nothing",
    ),
    (
        "31 people of LFW, accuracy",
        "{people|geometry + albedo|LFW}",
        "LBP with mirror image {people|LBP with mirror image (control)|LFW}",
        "nothing",
    ),
    (
        "9 people of Yale B, light to 77°",
        "{identity|geometry + albedo|to 77°}",
        "Gradientfaces {identity|Gradientfaces (control)|to 77°}",
        "beyond {identity|Gradientfaces (control)|beyond} to {identity|geometry + albedo|beyond}; "
        "128 pixels {identity|Gradientfaces, 128 pixels (control)|to 77°} to "
        "{identity|`faces-128`, 128 pixels|to 77°}",
    ),
    (
        "19 face parts from 640 masks, mIoU",
        "{segmentation|joint encoders and decoder, distilled|640 masks}",
        "one fresh encoder {segmentation|random start, one encoder (control)|640 masks}",
        "100 masks: PCA "
        "{segmentation|PCA (64), each place's classes by linear regression (control)|100 masks} to "
        "{segmentation|joint encoders and decoder, distilled|100 masks}",
    ),
    (
        "depth of generated cars, SIDE x 100 (low)",
        "{heads|`cars-64`, generated cars|SIDE x 100}",
        "average depth {heads|average depth of cars (control)|SIDE x 100}",
        "nothing",
    ),
)


def segmented(_: Any) -> Iterator[list[str]]:
    """mIoU of each network with fewer and fewer masks, and the paper's."""
    yield ["mIoU", *(f"{count} masks" for count in MASKS), "the paper"]
    paper = {line.method: line.scores for line in SEGMENTATION.paper}
    for name, (title, method) in NETS.items():
        scores = [kept(file)["rows"][name]["scores"]["mean_iou"] for file in MASKS.values()]
        yield [
            title,
            *(f"{one['value']:.3f}" + (f" ± {one['spread']:.3f}" if one["spread"] else "") for one in scores),
            f"{paper[method]['mean_iou']:.3f}" if method else "",
        ]


MASKS = {count: f"published/segmentation-{count}.json" for count in (640, 320, 100)}
NETS = {  # by their names in the files: a row's title, and that of the paper
    "joint, decoder too": ("joint encoders and decoder, distilled", "Joint Encoders"),
    "random start, joint": ("random start, joint (control)", ""),
    "random start": ("random start, one encoder (control)", "Supervised (random init)"),
    "PCA": ("PCA (64), each place's classes by linear regression (control)", ""),
    "each place's class": ("each place's most frequent class (control)", ""),
}


def edits(which: str, angles: Mapping[str, str], names: Mapping[str, str]) -> Reader:
    """PSNR and SSIM of edited photographs by angle."""

    def read(result: Any) -> Iterator[list[str]]:
        yield ["PSNR, dB / SSIM", *angles.values()]
        for name, title in names.items():
            shown = (result[which][name].get(angle) for angle in angles)
            yield [title, *("" if one is None else f"{one[0]:.1f} / {one[1]:.3f}" for one in shown)]

    return read


def edits_of_yale(result: Any) -> Iterator[list[str]]:
    """The same, then the light predicted from another person's image, beside the mean image in that light."""
    yield from edits(
        "yale", LIGHTS, EDITS | {"another person's ratio": "ratio of another person's photographs"}
    )(result)
    lit = kept("published/relighting.json")
    for name, title in RELIT.items():
        scores = [[lit[key][name]["scores"][angle]["value"] for key in ("psnr", "ssim")] for angle in LIT]
        yield [title, *(f"{psnr:.1f} / {ssim:.3f}" for psnr, ssim in scores)]


EDITS = {
    "derender": "derender, photograph's own pixels",
    "the same scene, model's colours": "model's rendering of the same scene",
    "input, brightness of the truth": "unchanged, brightness of the truth",
}
LIGHTS = {f"up to {angle}": f"up to {angle}°" for angle in (12, 25, 50, 77)} | {"beyond": "beyond 77°"}
LIT = [f"<= {angle}" for angle in (12, 25, 50, 77)] + ["beyond"]
RELIT = {
    "photograph relit": "light predicted from another person: derender",
    "mean image": "mean image of the others in that light",
}
HEADS = {f"light {angle}": f"light {angle}°" for angle in (25, 45, 65)} | {
    "view 15": "view 15°",
    "view 30": "view 30°",
}


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


def demo(result: Any) -> Iterator[list[str]]:
    """What the demo's own model reaches, each score beside its strongest control."""
    yield ["", "this run", "strongest control"]
    depth, people, images = result["geometry"], result["clustering"], result["reconstruction"]
    for how in ("40 steps per image", "feed-forward"):
        row = f"{depth[f'this run, {how}']['SIDE x 100']:.3f}"
        yield [
            f"depth, SIDE x 100, {how} (low)",
            row,
            f"average depth {depth['average depth']['SIDE x 100']:.3f}",
        ]
    own, *controls = people
    best = max(controls, key=lambda name: people[name]["accuracy"])
    yield ["people, accuracy", f"{people[own]['accuracy']:.3f}", f"{best} {people[best]['accuracy']:.3f}"]
    own, *controls = images
    best = min(controls, key=lambda name: images[name]["L1"])
    yield ["reconstruction, L1 (low)", f"{images[own]['L1']:.4f}", f"{best} {images[best]['L1']:.4f}"]


def probed(result: Any) -> Iterator[list[str]]:
    """Balanced accuracy of each probe with few and with many labels."""
    names = [name for name in result["parts"][0]["rows"] if name not in ("majority", "chance")]
    yield ["probe, labels", *(name if name == names[0] else f"{name} (control)" for name in names)]
    for part in result["parts"]:
        if part["labels"] != 500:
            scores = (part["rows"][name]["scores"]["balanced_accuracy"]["value"] for name in names)
            yield [f"{part['head']}, {part['labels']:,}", *(f"{score:.3f}" for score in scores)]


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


def disentangled(_: Any) -> Iterator[list[str]]:
    """Similarity between factors and the swap test of two sets, of the models and each control."""
    yield ["", *(f"{what}: {name}" for what in DISENTANGLED for name in LIKENESS)]
    files = [kept(file)["rows"] for file in DISENTANGLED.values()]
    for name in files[0]:
        cells = [
            mean(seeds, *where) for file in files for seeds in [file[name]] for where in LIKENESS.values()
        ]
        yield [name if name == "model" else f"{name} (control)", *cells]


def mean(seeds: Sequence[Any], part: str, key: str, digits: int) -> str:
    """The mean of one number over seeds, nothing where there is none."""
    values = [one[part][key] for one in seeds if one[part]]
    return f"{fmean(values):.{digits}f}" if values else ""


DISENTANGLED = {"heads": "generated/disentanglement.json", "LFW": "published/disentanglement-lfw.json"}
LIKENESS = {
    "Pearson": ("pearson", "mean_per_dimension", 3),
    "swap test": ("swap", "ratio", 2),
}


def aligned(result: Any) -> Iterator[list[str]]:
    yield ["faces found", "recall", "precision", "eye error, mean", "90th percentile"]
    for group in ("pasted", "lfw crops"):
        for name, row in result[group].items():
            keys = ("recall", "precision", "eye_error_mean", "eye_error_90th")
            yield [f"{group}: {name}", *(f"{row[key]:.3f}" for key in keys)]


def turns(result: Any) -> Iterator[list[str]]:
    """How far heads are turned, as measured, and which count as profiles."""
    yield ["pictures", "no face", "profile", "error, degrees", "90th percentile"]
    for name, row in result.items():
        if name != "machine":
            errors = ["" if row[key] is None else f"{row[key]:.1f}" for key in ("error_deg", "error_90_deg")]
            yield [name, *(f"{row[key]:.3f}" for key in ("no_face", "profile")), *errors]


def framings(result: Any) -> Iterator[list[str]]:
    """Cosine of features between crops of one image, beside that of two people."""
    yield ["features of one image", "cosine, mean", "lowest pair, mean", "two people"]
    for name, row in result["framings"].items():
        keys = ("cosine_mean", "cosine_lowest_mean", "cosine_of_two_people")
        sets, _, option = name.partition(", ")
        yield [f"{sets}, `{option}`", *(f"{row[key]:.3f}" for key in keys)]


def angles(_: Any) -> Iterator[list[str]]:
    """Correlation, slope and error of each angle, beside the error of a constant answer."""
    yield ["angle", "r", "slope", "error, degrees", "constant answer, degrees"]
    for file, (names, note) in ANGLES.items():
        result = kept(file)
        for name in names:
            model = {key: score["value"] for key, score in result[name]["model"]["scores"].items()}
            control = result[name]["constant answer"]["scores"]["error"]["value"]
            cells = [f"{model[key]:.3f}" for key in ("r", "slope")] + [f"{model['error']:.1f}"]
            yield [name + note, *cells, f"{control:.1f}"]


ANGLES = {
    "pose.json": (("yaw", "pitch", "roll"), " of the head"),
    "published/light.json": (("azimuth", "elevation"), " of the light"),
    "published/light-optimised.json": (("azimuth", "elevation"), ", 10 steps per image"),
}


def killed(result: Any) -> Iterator[list[str]]:
    """Kills of each group of commands: how many hit a file being written, and how the runs ended."""
    yield ["commands", "kills", "while writing", "runs that end bit-identical", "faults"]
    for names in KILLED:
        rows = [result["commands"][name] for name in names]
        kills, writing, rounds, survived = (
            sum(row[key] for row in rows) for key in ("kills", "writing", "rounds", "survived")
        )
        shown = ", ".join(f"`{KILLED_AS.get(name, name)}`" for name in names)
        yield [
            shown,
            f"{kills}",
            f"{writing}",
            f"{survived} of {rounds}",
            f"{sum(len(row['faults']) for row in rows)}",
        ]


KILLED = (
    ("train", "finetune"), ("embed", "compare", "identify", "plan"), ("explain", "report"),
    ("whiten", "refine", "unet", "pack"),
    ("align", "decompose", "mesh", "relight", "rotate", "swap", "video"),
)  # fmt: skip
KILLED_AS = {"identify": "evaluate identify", "plan": "compare --plan", "video": "relight CLIP"}

FILES: dict[str, tuple[str, Reader]] = SIDE_BY_SIDE | {  # files, the first for the reader
    "segmentation": (" ".join(MASKS.values()), segmented),
    "summary": (
        f"{HEADS_FILE} generated/people.json {LFW} published/identity.json published/identity-128.json "
        f"{CARS} {MASKS[640]} {MASKS[100]}",
        summary,
    ),
    "faces-128": ("sharpness.json", sharp),
    "edits-yale": ("photo_edits.json published/relighting.json", edits_of_yale),
    "edits-heads": (
        "photo_edits.json",
        edits("generated heads", HEADS, EDITS | {"input turned as a plane": "turned as a plane"}),
    ),
    "angles": (" ".join(ANGLES), angles),
    "robustness": (" ".join(ROBUST.values()), turned_and_lit),
    "true-factors": ("generated/disentanglement.json", true_factors),
    "disentanglement": (" ".join(DISENTANGLED.values()), disentangled),
    "celeba-labels": ("published/celeba-labels.json", probed),
    "paper-clustering": (
        " ".join(f"published/compare-{one}.json" for one in theirs.PARTS),
        theirs.beside_the_paper,
    ),
    "paper-linear": ("published/compare-linear.json", theirs.few_labels),
    "paper-gpu": ("paper-gpu.json", theirs.preset),
    "seeds": (" ".join(("seeds.json", *trained.SEEDED_FILES)), trained.seeds),
    "seeds-heads": ("seeds-heads.json", trained.seeds_rendered),
    "seeds-cars": ("seeds-cars.json", trained.seeds_rendered),
    "ladder": (" ".join(("ladder.json generated/heads.json", *trained.LADDER_CONTROLS)), trained.ladder),
    "demo": ("demo.json", demo),
    "renderers": ("renderers_fit.json", drawn.renderers),
    "renderers-speed": ("renderers_speed.json", drawn.renderer_speed),
    "renderers-train": ("renderers_train.json", drawn.renderers),
    "renderers-numbers": ("renderers_train.json", drawn.renderer_numbers),
    "renderers-yale": ("renderers_yaleb.json", drawn.renderers_yale),
    "kills": ("kills.json", killed),
    "align": ("align.json", aligned),
    "framings": ("align.json", framings),
    "turns": ("yaw.json", turns),
    "bench": ("bench.json", speed.shares),
    "training-step": ("training_step.json", speed.training_step),
    "step-profile": ("step_profile.json", speed.step_profile),
    "gpu-steps": ("gpu.json", speed.gpu_steps),
    "fitting": ("fitting.json", speed.fitting),
    "disentangle-speed": ("disentangle.json", speed.before),
    "embedding-speed": ("embed_before.json", speed.before),
    "rasterize": ("rasterize.json", speed.rasterize),
    "peers": ("rasterize_peers.json", speed.peers),
    "step-memory": ("step_memory.json", speed.step_memory),
    "million": ("clustering_million.json", speed.million),
    "table-million": ("table_million.json", speed.million_rows),
}
