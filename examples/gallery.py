"""The pictures of the site but portraits and conventions: docs/images/gallery, made anew by one command.

    .venv/bin/python examples/gallery.py                             # test heads of the generated benchmark
    .venv/bin/python examples/gallery.py --data heads.zip::test      # a rendered set with true maps
    .venv/bin/python examples/gallery.py --only swap                 # one picture

Every picture is evenly spaced through its data and none is chosen. Only rendered or generated data belongs
here: show no image of a real person. Look at the pictures before you commit them. Edits in a photograph's own
pixels look the same with `faces-64` and `faces-128`.
"""

import argparse
import sys
import tempfile
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import torch
from PIL import Image
from portraits import portraits

import derender
from derender.cli import main as command
from derender.data import as_float, read_ground_truth
from derender.data.synthetic import PARTS, cars, faces, write_generated
from derender.data.synthetic.settings import CLASSES, LIGHTS, VIEWS, CarSettings, FaceSettings, named_settings
from derender.data.synthetic.synthetic_set import SyntheticSet
from derender.evaluation.truth import predicted_depth
from derender.photo import open_photograph
from derender.report import colours
from derender.report.panel import GridLayout, contact_sheet, labelled_grid
from derender.scene.normals import normals_from_depth

OUT = Path(__file__).resolve().parents[1] / "docs" / "images" / "gallery"
CELL, FACES, SEARCHED, ACROSS = 192, 4, 400, 6
MODEL, SIZE = "rendered-faces-128", 128


def run(*words: object) -> None:
    """One command of derender, which must succeed."""
    if code := command([str(word) for word in words]):
        raise SystemExit(code)


def keep(picture: Path | Image.Image, name: str, width: int = 1700) -> None:
    """A picture in 24-bit colour on white, at most so wide."""
    drawn = picture if isinstance(picture, Image.Image) else Image.open(picture)
    drawn = colours.on_background(drawn) if drawn.mode == "RGBA" else drawn.convert("RGB")
    drawn.thumbnail((width, 10 * width), Image.Resampling.LANCZOS)
    OUT.mkdir(parents=True, exist_ok=True)
    drawn.save(OUT / name, quality=88, method=6) if name.endswith(".webp") else drawn.save(OUT / name)


def grid(rows: Mapping[str, list[Image.Image]], heads: list[str]) -> Image.Image:
    """A row for each entry under its name, narrow enough for a page to show tiles at their size."""
    columns = zip(*rows.values(), strict=True)
    return labelled_grid(
        dict(zip(heads, map(list, columns), strict=True)), list(rows), layout=GridLayout(CELL)
    )


def side(yaw_deg: float) -> str:
    """An angle of light in words; yaw above 0 lights the left of the image."""
    return f"{abs(yaw_deg):.0f}° {'left' if yaw_deg > 0 else 'right'}"


def decompose(data: str, work: Path) -> None:
    """Predicted maps of `rendered-faces-128` beside the true ones, in the view of the image."""
    model, truth = derender.load(MODEL), read_ground_truth(data, image_size=SIZE)
    rows = np.linspace(0, len(truth) - 1, FACES).round().astype(int)
    heads = [f"{n}: light {side(yaw)}" for n, yaw in enumerate(np.degrees(truth.light[rows, 3]), 1)]
    images, mask = truth.images[rows], truth.mask[rows]
    depth, covered = predicted_depth(model, images)
    both = (covered & torch.as_tensor(mask)).float()
    filled = torch.where(covered, depth, torch.ones_like(depth))
    scene = model.decompose(as_float(images))
    flat = model.render(scene.with_parameters(light=torch.tensor([[1.0, 0, 0, 0]]).expand(FACES, 4)))
    maps = {
        "input": colours.pictures(images),
        "reconstruction": colours.pictures(model.render(scene).image),
        "depth": colours.depth_maps(depth, both),
        "true depth": colours.depth_maps(truth.depth[rows], mask),
        "normals": colours.normal_maps(normals_from_depth(filled, model.fov_deg), both),
        "true normals": colours.normal_maps(truth.normal[rows], mask),
        "albedo": colours.pictures(flat.image, both),
        "true albedo": colours.pictures(truth.albedo[rows], mask),
    }
    keep(grid(maps, heads), "decompose.webp")


def swap(data: str, work: Path) -> None:
    """Three portraits, each with one factor of a fourth, in their own pixels."""
    files = [work / f"portrait {number}.png" for number in range(4)]
    for file, image in zip(files, portraits(512), strict=False):
        image.save(file)
    run(
        "swap", "--model", "faces-64", *files[1:], "--from", files[0], "--size", CELL, "--out", work / "mixed"
    )
    opened = open_photograph(np.asarray(Image.open(files[0])), derender.load("faces-64"))
    light = side(np.degrees(float(opened.scene.light[0, 3])))
    parts = ("its geometry", "its albedo", f"its light, {light}", "its camera")
    stills = {part: f"still-{number:02d}.png" for number, part in enumerate(parts, 1)}
    drawn = {"input": [Image.open(file) for file in files[1:]], "the other": [Image.open(files[0])] * 3}
    for part, still in stills.items():
        drawn[part] = [Image.open(work / "mixed" / file.stem / still) for file in files[1:]]
    keep(grid(drawn, ["1", "2", "3"]), "swap.webp")


def search(data: str, work: Path) -> None:
    """The nearest by geometry and by lighting, of one image, with their true angle of light."""
    truth, model = read_ground_truth(data, image_size=SIZE), derender.load(MODEL)
    table, pixels = derender.embed(data, model, fit_steps=0), colours.pictures(truth.images)
    for factor in ("geometry", "light"):
        query = len(truth) // 2
        match = derender.search(table, like=truth.files[query], model=model, factor=factor, k=7)
        rows = [query, *(truth.files.index(file) for file in match.files)]
        captions = [f"light {side(np.degrees(truth.light[row, 3]))}" for row in rows]
        captions[0] = f"query, {captions[0]}"
        sheet = contact_sheet(
            [pixels[row] for row in rows], captions, 4, f"nearest by {factor}", GridLayout(CELL)
        )
        keep(sheet, f"search_{factor}.webp")


def explain(data: str, work: Path) -> None:
    """Shares of factors in the answers of a probe of expressions."""
    run("explain", "--model", "rendered-faces-64", "--data", data, "--limit", SEARCHED, "--label", "expression",  # noqa: E501
        "--seeds", 1, "--sheets", 1, "--rows", 3, "--out", work / "why")  # fmt: skip
    keep(work / "why" / "shares.png", "explain.png", 1100)


def generated(data: str, work: Path) -> None:
    """Twelve generated people, and cars; one of each under other lighting and views; its true maps."""
    wide = FaceSettings(light=LIGHTS["wide"], view=VIEWS["wide"], pictures_per_identity=ACROSS)
    people = faces.generate(2 * ACROSS, CELL, seed=1, settings=FaceSettings(pictures_per_identity=1))
    keep(
        tiles(people, people.images, faces.generate(ACROSS, CELL, seed=2, settings=wide).images), "faces.webp"
    )
    each = [CarSettings(classes={name: 1.0}) for name in CLASSES]
    classes = [cars.generate(1, CELL, seed=1, settings=one).images for one in each[: 2 * ACROSS]]
    turned = cars.generate(ACROSS, CELL, seed=2, settings=CarSettings(pictures_per_model=ACROSS))
    keep(tiles(turned, *classes, turned.images), "cars.webp")


def tiles(truth: SyntheticSet, *images: np.ndarray) -> Image.Image:
    """Tiles of these images, and a row of one set's first: image, albedo, depth, normals, mask and parts."""
    first, mask = slice(1), truth.mask[:1]
    hue = truth.parts[first, :, :, None] * 2.4 + np.array([0, 2.1, 4.2])  # far apart for neighbouring numbers
    cells = [cell for some in images for cell in colours.pictures(some)]
    cells += colours.pictures(truth.images[first]) + colours.pictures(truth.albedo[first], mask)
    cells += colours.depth_maps(truth.depth[first], mask) + colours.normal_maps(truth.normal[first], mask)
    cells += colours.level_maps(mask) + colours.pictures(np.moveaxis(0.5 + 0.45 * np.cos(hue), -1, 1), mask)
    drawn = Image.new("RGB", (ACROSS * CELL, len(cells) // ACROSS * CELL), "white")
    for number, cell in enumerate(cells):
        corner = number % ACROSS * CELL, number // ACROSS * CELL
        drawn.paste(colours.on_background(cell), corner)
    return drawn


PICTURES = {
    "decompose": decompose, "swap": swap, "search": search, "explain": explain, "generated": generated,
}  # fmt: skip


def main() -> None:
    words = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    words.add_argument("--data", help="rendered heads with true maps; by default the generated benchmark's")
    words.add_argument("--only", choices=PICTURES, action="append", help="make these pictures only")
    given = words.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        work = Path(folder)
        data = given.data or str(work / "made" / "test")
        if given.data is None:
            part = PARTS["faces"]["test"]
            chosen = named_settings(FaceSettings, part.ranges, part.ranges, part.overrides)
            write_generated("faces", Path(data), part.count, SIZE, part.seed, chosen, part.truth)
        for name in given.only or PICTURES:
            PICTURES[name](data, work)
            print(name)


if __name__ == "__main__":
    sys.exit(main())
