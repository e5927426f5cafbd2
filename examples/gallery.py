"""docs/gallery.md and its images, made anew by one command from rendered faces and cars and trained models.

    python examples/gallery.py                                          # faces and cars of `derender synth`
    python examples/gallery.py --data faces.zip::test --label expression --cars cars.zip::test # other ones

Every image is what a command wrote; the page says which. Only rendered data belongs in a gallery: show no
image of a real person. The whole folder of images is replaced, and kept under 4 MB.
"""

import argparse
import shutil
import sys
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from PIL import Image

from derender.cli import main as derender

ROOT = Path(__file__).resolve().parents[1]
PAGE, PICTURES = ROOT / "docs" / "gallery.md", ROOT / "docs" / "images" / "gallery"
MOST_BYTES = 4_000_000
FACES, SEARCHED = 4, 400
FILM = ("--size", "160", "--frames", "24", "--seconds", "2.4", "--film", "gif", "--stills", "5")
SHOWN = (
    (
        "Decomposed",
        {
            "decompose.png": "Four faces: input, reconstruction, depth, normals, albedo, shading, another "
            "light, another view"
        },
        "decompose --model {model} face*.png --sheet --out apart/",
    ),
    (
        "The light moved",
        {
            "relight.gif": "Two faces while the light goes from right to left and back",
            "relight.png": "The same as stills",
        },
        "relight --model {model} face*.png --out relit/",
    ),
    (
        "The head turned",
        {"rotate.gif": "Two faces turning from side to side"},
        "rotate --model {model} face*.png --out turned/",
    ),
    (
        "One factor of another face",
        {"swap.png": "Three faces, each with the geometry, albedo, light and camera of a fourth"},
        "swap --model {model} face*.png --from other.png --out mixed/",
    ),
    (
        "As a mesh: the file as another program reads it, with its texture and without",
        {"mesh.png": "A GLB file from three sides"},
        "mesh --model {model} face.png --out mesh/",
    ),
    (
        "Found by one factor: the same geometry in any light, the same light on anybody",
        {
            "search_geometry.png": "A face and the six nearest to it by geometry",
            "search_light.png": "The same face and the six nearest to it by light",
        },
        "search --features F.parquet --like face.png --model {model} --factor geometry --out found.png",
    ),
    (
        "Which factor answers",
        {
            "explain.png": "Shares of geometry, albedo, light and camera by class of the label {label}, "
            "beside controls",
            "explain_maps.png": "Where the encoders saw evidence for one of the classes",
        },
        "explain --model {model} --data faces/ --label {label} --out why/",
    ),
    (
        "Cars, by the model `cars-64`",
        {
            "cars.png": "Four cars: input, reconstruction, depth, normals, albedo, shading, another light, "
            "another view",
            "cars.gif": "Two cars turning from side to side",
        },
        "rotate --model cars-64 car*.png --out turned/",
    ),
)
CREDIT_OWN = "Faces and cars are drawn by `derender synth` and show nobody."


def main() -> int:
    """Make the gallery; gives the exit code of the first command that fails."""
    words = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    words.add_argument(
        "--model", default="rendered-faces-64", help="a run folder, saved folder or bundled name"
    )
    words.add_argument("--data", help="rendered faces; by default derender synth makes them")
    words.add_argument("--label", default="expression", help="the label that is explained")
    words.add_argument("--cars", help="rendered cars; by default derender synth makes them")
    words.add_argument("--credit", default=CREDIT_OWN, help="where faces and cars come from, for the page")
    asked = words.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        work = Path(folder)
        data = asked.data or str(work / "made")
        if asked.data is None:
            run("synth", "faces", "--out", data, "--count", str(SEARCHED), "--no-truth")
        cars = asked.cars or str(work / "made-cars")
        if asked.cars is None:
            run("synth", "cars", "--out", cars, "--count", str(FACES))
        drawn = draw(asked.model, data, asked.label, some_pictures(data, work / "faces", "face"), work)
        draw_cars(some_pictures(cars, work / "cars", "car"), work, drawn)
        size = sum(picture.stat().st_size for picture in drawn.iterdir())
        if size > MOST_BYTES:
            raise SystemExit(f"the images take {size:,} bytes, more than {MOST_BYTES:,}")
        shutil.rmtree(PICTURES, ignore_errors=True)
        shutil.copytree(drawn, PICTURES)
    given = {"data": asked.data, "cars": asked.cars}
    PAGE.write_text(page(asked.model, asked.label, asked.credit, given), encoding="utf-8")
    print(f"{PAGE} and {size / 1e6:.1f} MB of images")
    return 0


def run(*arguments: str) -> None:
    """One command of derender, which must succeed."""
    code = derender(arguments)
    if code:
        raise SystemExit(code)


def some_pictures(data: str, folder: Path, thing: str) -> list[str]:
    """A few images of the data, evenly chosen, as files."""
    from derender.data import read_images

    pictures = read_images(data, 64, limit=FACES)
    folder.mkdir()
    names = []
    for number, picture in enumerate(pictures.images, 1):
        names.append(str(folder / f"{thing} {number}.png"))
        Image.fromarray(np.moveaxis(picture, 0, -1)).save(names[-1])
    return names


def draw(model: str, data: str, label: str, faces: Sequence[str], work: Path) -> Path:
    """Run every command of the gallery, and collect what it shows."""
    out = work / "drawn"
    out.mkdir()
    given = ("--model", model)
    one, two = Path(faces[0]).stem, Path(faces[1]).stem
    run("decompose", *given, *faces, "--sheet", "--out", str(work / "apart"))
    keep(work / "apart" / "sheet.png", out / "decompose.png")
    run("relight", *given, *faces[:2], *FILM, "--out", str(work / "relit"))
    side_by_side([work / "relit" / name / "film.gif" for name in (one, two)], out / "relight.gif")
    keep(work / "relit" / "sheet.png", out / "relight.png")
    run("rotate", *given, *faces[:2], *FILM, "--out", str(work / "turned"))
    side_by_side([work / "turned" / name / "film.gif" for name in (one, two)], out / "rotate.gif")
    run("swap", *given, *faces[1:], "--from", faces[0], "--size", "128", "--out", str(work / "mixed"))
    keep(work / "mixed" / "sheet.png", out / "swap.png")
    run("mesh", *given, faces[1], "--size", "128", "--out", str(work / "mesh"))
    mesh_picture(work / "mesh" / two / f"{two}.glb").save(out / "mesh.png", optimize=True)
    table = str(work / "features.parquet")
    limited = ("--data", data, "--limit", str(SEARCHED))
    run("embed", *given, *limited, "--out", table)
    for factor in ("geometry", "light"):
        found = str(out / f"search_{factor}.png")
        like = ("--like", faces[2], "--factor", factor, "-k", "6")
        run("search", "--features", table, *like, *given, "--data", data, "--out", found)
        keep(Path(found), Path(found))
    run("explain", *given, *limited, "--label", label, "--seeds", "1", "--sheets", "1", "--rows", "3",
        "--out", str(work / "why"))  # fmt: skip
    keep(work / "why" / "shares.png", out / "explain.png")
    sheet = next((work / "why").glob("maps-1-*hires*.png"))
    keep(sheet, out / "explain_maps.png")
    return out


def draw_cars(cars: Sequence[str], work: Path, out: Path) -> None:
    """The same for cars, in short."""
    given = ("--model", "cars-64")
    run("decompose", *given, *cars, "--sheet", "--out", str(work / "cars-apart"))
    keep(work / "cars-apart" / "sheet.png", out / "cars.png")
    run("rotate", *given, *cars[:2], *FILM, "--out", str(work / "cars-turned"))
    films = [work / "cars-turned" / Path(name).stem / "film.gif" for name in cars[:2]]
    side_by_side(films, out / "cars.gif")


def keep(source: Path, target: Path, width: int = 1100) -> None:
    """An image at most so wide, with 256 colours, dithered: depth and normals show no steps."""
    with Image.open(source) as picture:
        drawn = picture.convert("RGBA")
    small = Image.new("RGB", drawn.size, "white")
    small.paste(drawn, mask=drawn)
    if small.width > width:
        small = small.resize((width, round(small.height * width / small.width)), Image.Resampling.LANCZOS)
    colours = small.quantize(256)  # which are chosen without dithering, whatever is asked
    small.quantize(palette=colours, dither=Image.Dither.FLOYDSTEINBERG).save(target, optimize=True)


def side_by_side(sources: Sequence[Path], target: Path, gap: int = 8) -> None:
    """Films of equal length next to each other."""
    films = []
    for source in sources:
        with Image.open(source) as film:
            frames = []
            for number in range(getattr(film, "n_frames", 1)):
                film.seek(number)
                frames.append(film.convert("RGB"))
            films.append(frames)
            duration = film.info["duration"]
    joined = []
    for row in zip(*films, strict=True):
        width = sum(frame.width + gap for frame in row) - gap
        canvas = Image.new("RGB", (width, row[0].height), "white")
        for place, frame in enumerate(row):
            canvas.paste(frame, (place * (frame.width + gap), 0))
        joined.append(canvas.quantize(256))
    first, *rest = joined
    first.save(target, save_all=True, append_images=rest, duration=duration, loop=0)


def mesh_picture(glb: Path, views_deg: Sequence[int] = (-55, 0, 55), side: int = 200) -> Image.Image:
    """The file as another program reads it: textured on the left, surface alone on the right of each view."""
    from typing import Any

    import trimesh

    read: Any = trimesh.load(glb, force="mesh")
    texture = np.asarray(read.visual.material.baseColorTexture.convert("RGB")) / 255
    height, width = texture.shape[:2]
    share = inner_points(24)
    places, uv, normals = (
        (share @ np.asarray(values)[read.faces]).reshape(-1, values.shape[1])
        for values in (read.vertices, read.visual.uv, read.vertex_normals)
    )
    column = np.clip((uv[:, 0] * width).astype(int), 0, width - 1)
    row = np.clip(((1 - uv[:, 1]) * height).astype(int), 0, height - 1)
    lit = (0.25 + 0.75 * np.clip(normals @ np.array([0.4, 0.3, 0.87]), 0, 1))[:, None]
    scale = 0.47 * side / np.abs(read.vertices[:, :2]).max()
    tiles = []
    for view in np.radians(views_deg):
        right = places @ (np.cos(view), 0, -np.sin(view))
        nearness = places @ (np.sin(view), 0, np.cos(view))
        for colours in (lit * texture[row, column], np.repeat(0.85 * lit, 3, axis=1)):
            tiles.append(seen(right * scale, places[:, 1] * scale, nearness, colours, side))
    picture = np.clip(np.concatenate(tiles, axis=1), 0, 1)
    return Image.fromarray((picture * 255).round().astype(np.uint8)).quantize(256)


def inner_points(count: int) -> np.ndarray:
    """(P, 3) shares of a triangle's corners, evenly over it."""
    a, b = (axis.ravel() for axis in np.meshgrid(np.arange(count), np.arange(count)))
    a, b = a[a + b < count] / (count - 1), b[a + b < count] / (count - 1)
    return np.stack((a, b, 1 - a - b), axis=1)


def seen(
    x: np.ndarray, y: np.ndarray, nearness: np.ndarray, colours: np.ndarray, side: int, finer: int = 2
) -> np.ndarray:
    """(side, side, 3) image on white of points, x right and y up from its middle: the nearest wins."""
    large = side * finer
    column = np.round(large / 2 + finer * x).astype(int)
    row = np.round(large / 2 - finer * y).astype(int)
    inside = (column >= 0) & (column < large) & (row >= 0) & (row < large)
    back_to_front = np.flatnonzero(inside)[np.argsort(nearness[inside], kind="stable")]
    canvas = np.ones((large, large, 3))
    canvas[row[back_to_front], column[back_to_front]] = colours[back_to_front]
    return canvas.reshape(side, finer, side, finer, 3).mean(axis=(1, 3))


def page(model: str, label: str, credit: str, sources: Mapping[str, str | None]) -> str:
    """The text of docs/gallery.md."""
    name = Path(model).name
    given = "".join(f" --{word} {Path(source).name}" for word, source in sources.items() if source)
    lines = [
        "# Gallery",
        f"Everything here was made from single images by the models `{name}` and `cars-64`, with "
        f"`python examples/gallery.py{given}`.\n{credit} No image was chosen: they are evenly spaced "
        "through the data.\nThe commands are told in [pictures.md](pictures.md) and "
        "[explain.md](explain.md).",
    ]
    for title, pictures, command in SHOWN:
        lines.append(f"## {title}")
        lines += [f"![{alt.format(label=label)}](images/gallery/{file})" for file, alt in pictures.items()]
        lines.append(f"`derender {command.format(model=name, label=label)}`")
    return "\n\n".join(lines) + "\n"


if __name__ == "__main__":
    sys.exit(main())
