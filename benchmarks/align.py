"""How well faces are found: recall, precision, and where the eyes are, of pictures pasted at known places.

Pictures of LFW and of UTKFace (``--lfw``, ``--utkface``: folders or zips of 128-pixel crops) are pasted into
larger ones at sizes from 40 to 800 pixels, rolled by up to 30 degrees, on generated backgrounds: blobs,
noise, stripes, clutter and rendered cars. Of LFW the true eyes are known (``--points``, landmarks of a face
mesh): the error is the mean distance of both eyes, as a share of the distance between them. A face counts as
found where the middle of its eyes lies within half that distance of the truth. LFW's crops as they are make a
second table. Three detectors are compared: MTCNN as ``derender.photo.find_faces`` uses it, MTCNN as its
package gives it, and the LBP cascade of scikit-image; with ``--blazeface`` a fourth, a .tflite of BlazeFace
(full range). At last the features of one picture in several framings.

    .venv/bin/python benchmarks/align.py --lfw lfw128.zip --utkface utkface128.zip \\
        --points lfw128_facemesh.npz --json benchmarks/results/align.json
"""

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from machine import parser, publish
from PIL import Image, ImageDraw, ImageFilter

import derender
from derender.data import open_source
from derender.data.image import decode_whole
from derender.data.synthetic import cars
from derender.photo import Frame, found_frame
from derender.photo.faces import SMALLEST_FACE, UTKFACE, detector, find_faces

SIDES, ROLL_DEG = (40, 800), 30
BANDS = (40, 80, 160, 320, 801)
LEFT_EYE, RIGHT_EYE = (33, 133, 159, 145), (263, 362, 386, 374)  # of the face mesh, left in the image first
Eyes = np.ndarray  # (2, 2): left and right in the image, in pixels
Detector = Callable[[np.ndarray], list[Eyes]]


@dataclass
class Case:
    """A picture and the eyes of its faces; ``exact`` where they were measured, not taken from the average."""

    pixels: np.ndarray
    eyes: list[Eyes]
    sides: list[float]
    exact: list[bool]


class Faces:
    """Crops of a data set with the eyes in each, in shares of its side; one half of the people."""

    def __init__(self, path: Path, half: str, points: dict[str, np.ndarray] | None = None):
        self.source, self.points = open_source(path), points
        files = [f for f in self.source.files if f.endswith(".jpg") and (points is None or f in points)]
        people = sorted({self.person(file) for file in files})
        chosen = set(people[0 if half == "first" else 1 :: 2])
        self.files = [file for file in files if self.person(file) in chosen]

    def person(self, file: str) -> str:
        """LFW's folder; each UTKFace picture is a person of its own."""
        return Path(file).parent.name if self.points else Path(file).name

    def draw(self, number: int) -> tuple[np.ndarray, Eyes]:
        """Crop and eyes."""
        file = self.files[number % len(self.files)]
        eyes = np.array(UTKFACE[:2]) if self.points is None else self.points[file]
        return decode_whole(self.source.read(file)), eyes


def eyes_of_mesh(path: Path) -> dict[str, np.ndarray]:
    """Eyes in shares of the 128-pixel crop, by file."""
    stored = np.load(path)
    marks = stored["landmarks"][..., :2].astype(float) / 128
    pairs = np.stack([marks[:, LEFT_EYE].mean(axis=1), marks[:, RIGHT_EYE].mean(axis=1)], axis=1)
    return dict(zip(stored["name"].tolist(), pairs, strict=True))


def background(rng: np.random.Generator, width: int, height: int) -> Image.Image:
    """Blobs, fine noise, stripes, clutter and a rendered car or two; no face."""
    cells = int(rng.integers(3, 40))
    coarse = rng.integers(0, 256, (cells, cells * width // height, 3), dtype=np.uint8)
    canvas = Image.fromarray(coarse).resize((width, height), Image.Resampling.BICUBIC)
    draw = ImageDraw.Draw(canvas)
    for _ in range(int(rng.integers(0, 60))):
        x, y = rng.uniform(0, width), rng.uniform(0, height)
        a, b = rng.uniform(5, width / 5, 2)
        colour = tuple(rng.integers(0, 256, 3).tolist())
        shape = (draw.ellipse, draw.rectangle)[int(rng.integers(2))]
        shape((x, y, x + a, y + b), fill=colour, outline=tuple(rng.integers(0, 256, 3).tolist()))
    for _ in range(int(rng.integers(0, 4))):
        side = int(rng.integers(60, height // 2))
        car = cars.generate(1, 128, seed=int(rng.integers(10**6)))
        tile = Image.fromarray(np.ascontiguousarray(car.images[0].transpose(1, 2, 0)))
        canvas.paste(
            tile.resize((side, side), Image.Resampling.LANCZOS),
            (int(rng.integers(0, width - side)), int(rng.integers(0, height - side))),
        )
    if rng.random() < 0.3:
        canvas = canvas.filter(ImageFilter.GaussianBlur(rng.uniform(0.5, 4)))
    pixels = np.asarray(canvas).astype(float)
    if rng.random() < 0.3:
        pixels = pixels + 20 * np.sin(np.arange(width) * rng.uniform(0.05, 1.5))[None, :, None]
    return Image.fromarray(
        np.clip(pixels + rng.normal(0, rng.uniform(0, 12), pixels.shape), 0, 255).astype("u1")
    )


def pasted(faces: list[Faces], count: int, seed: int) -> Iterator[Case]:
    """Pictures of 1 to 3 faces; every tenth has none."""
    rng = np.random.default_rng(seed)
    order = [rng.permutation(len(one.files)) for one in faces]
    for number in range(count):
        largest = np.exp(rng.uniform(*np.log(SIDES)))
        scale = max(1.0, largest / 350)
        width, height = int(rng.uniform(800, 1100) * scale), int(rng.uniform(600, 900) * scale)
        canvas, case, taken = background(rng, width, height), Case(np.empty(0), [], [], []), []
        for place in range(0 if number % 10 == 9 else int(rng.integers(1, 4))):
            which = int(rng.integers(len(faces)))
            pixels, eyes = faces[which].draw(int(order[which][(3 * number + place) % len(order[which])]))
            side = largest if place == 0 else np.exp(rng.uniform(np.log(SIDES[0]), np.log(largest)))
            roll = np.radians(rng.uniform(-ROLL_DEG, ROLL_DEG))
            reach = side * 0.71
            if 2 * reach >= min(width, height):
                reach = min(width, height) / 2 - 1
            centre = np.array([rng.uniform(reach, width - reach), rng.uniform(reach, height - reach)])
            if any(np.hypot(*(centre - other)) < reach + far for other, far in taken):
                continue
            taken.append((centre, reach))
            size = round(side)
            tile = Image.fromarray(pixels).resize((size, size), Image.Resampling.LANCZOS).convert("RGBA")
            tile = tile.rotate(-np.degrees(roll), Image.Resampling.BICUBIC, expand=True)
            corner = np.round(centre - np.array(tile.size) / 2).astype(int)
            canvas.paste(tile, tuple(corner.tolist()), tile)
            turn = np.array([[np.cos(roll), -np.sin(roll)], [np.sin(roll), np.cos(roll)]])
            middle = corner + np.array(tile.size) / 2
            case.eyes.append(middle + (eyes - 0.5) * size @ turn.T)
            case.sides.append(side)
            case.exact.append(faces[which].points is not None)
        case.pixels = np.asarray(canvas)
        yield case


def crops(faces: Faces, count: int) -> Iterator[Case]:
    """The crops as they are."""
    for number in np.linspace(0, len(faces.files) - 1, min(count, len(faces.files))).astype(int):
        pixels, eyes = faces.draw(int(number))
        yield Case(pixels, [eyes * len(pixels)], [float(len(pixels))], [True])


def of_package(pixels: np.ndarray) -> list[Eyes]:
    """MTCNN once, at the photograph's own size."""
    return [
        np.array([result["keypoints"][name] for name in ("left_eye", "right_eye")], float)
        for result in detector(SMALLEST_FACE).detect_faces(pixels)
    ]


def ours(pixels: np.ndarray) -> list[Eyes]:
    """As the library does it."""
    return [face.points[:2] for face in find_faces(pixels)]


def lbp() -> Detector:
    """The LBP cascade of scikit-image; eyes at their average place in its boxes."""
    from skimage import data
    from skimage.feature import Cascade

    cascade = Cascade(data.lbp_frontal_face_cascade_filename())

    def result(pixels: np.ndarray) -> list[Eyes]:
        largest = min(pixels.shape[:2])
        boxes = cascade.detect_multi_scale(
            img=pixels, scale_factor=1.2, step_ratio=1, min_size=(24, 24), max_size=(largest, largest)
        )
        offsets = np.array([[0.32, 0.40], [0.68, 0.40]])
        return [np.array([b["c"], b["r"]]) + offsets * b["width"] for b in boxes]

    return result


def scored(cases: Iterator[Case], detectors: dict[str, Detector]) -> dict[str, dict]:
    """Recall, precision, eye error and seconds a picture of each detector."""
    sums = {name: {"found": 0, "right": 0, "hit": [], "error": [], "seconds": 0.0} for name in detectors}
    sides, pictures = [], 0
    for case in cases:
        pictures += 1
        sides += case.sides
        for name, detect in detectors.items():
            begin, row = time.perf_counter(), sums[name]
            results = detect(case.pixels)
            row["seconds"] += time.perf_counter() - begin
            row["found"] += len(results)
            left = list(results)
            for truth, exact in zip(case.eyes, case.exact, strict=True):
                apart = np.hypot(*(truth[1] - truth[0]))
                away = [np.hypot(*(eyes.mean(axis=0) - truth.mean(axis=0))) for eyes in left]
                at = int(np.argmin(away)) if away else -1
                hit = at >= 0 and away[at] < apart / 2
                row["hit"].append(hit)
                if hit:
                    eyes = left.pop(at)
                    row["right"] += 1
                    if exact:
                        row["error"].append(float(np.hypot(*(eyes - truth).T).mean() / apart))
    band = np.digitize(sides, BANDS)
    result = {}
    for name, row in sums.items():
        hit, error = np.array(row["hit"]), np.array(row["error"])
        result[name] = {
            "pictures": pictures,
            "faces": len(hit),
            "recall": float(hit.mean()),
            "precision": row["right"] / max(1, row["found"]),
            "eye_error_mean": float(error.mean()),
            "eye_error_median": float(np.median(error)),
            "eye_error_90th": float(np.quantile(error, 0.9)),
            "recall_by_side": {
                f"{BANDS[k - 1]} to {BANDS[k] - 1}": float(hit[band == k].mean()) for k in np.unique(band)
            },
            "seconds": row["seconds"] / pictures,
        }  # fmt: skip
    return result


def framings(faces: Faces, count: int, seed: int) -> dict[str, dict[str, float]]:
    """Cosine of geometry and albedo of one picture in several framings, each with its face found anew.

    Nine framings: three sizes by three rolls, at other places of a larger picture. Three data sets: the crops
    as LFW, CelebA and UTKFace frame them. Beside them the cosine of two people, and of framings as they are.
    """
    rng, model = np.random.default_rng(seed), derender.load("faces-64")

    def features(pixels: list[np.ndarray], frame: str) -> np.ndarray | None:
        """(n, d) unit vectors; None where a face is missed."""
        try:
            cuts = [found_frame(one, model, frame).frame.cut(one, model.image_size) for one in pixels]
        except ValueError:
            return None
        results = model.embed(torch.from_numpy(np.stack(cuts)).float() / 255)
        both = [results[name].detach().flatten(1).numpy() for name in ("geometry", "albedo")]
        return (
            np.concatenate([one / np.linalg.norm(one, axis=1, keepdims=True) for one in both], axis=1)
            / 2**0.5
        )

    result: dict[str, dict[str, float]] = {}
    for kind in ("nine framings", "three data sets"):
        for frame in ("face", "none"):
            lowest, mean, first, missed = [], [], [], 0
            for number in np.linspace(0, len(faces.files) - 1, count).astype(int):
                tile, eyes = faces.draw(int(number))
                scene = background(rng, 640, 480)
                views = nine(scene, tile) if kind == "nine framings" else three(scene, tile, eyes)
                results = features(views, frame)
                if results is None:
                    missed += 1
                    continue
                alike = (results @ results.T)[np.triu_indices(len(results), 1)]
                lowest.append(alike.min()), mean.append(alike.mean()), first.append(results[0])
            others = np.array(first) @ np.array(first).T
            result[f"{kind}, --frame {frame}"] = {
                "pictures": len(first),
                "missed": missed,
                "cosine_mean": float(np.mean(mean)),
                "cosine_lowest_mean": float(np.mean(lowest)),
                "cosine_10th_of_lowest": float(np.quantile(lowest, 0.1)),
                "cosine_of_two_people": float(others[np.triu_indices(len(first), 1)].mean()),
            }
    return result


def nine(scene: Image.Image, tile: np.ndarray) -> list[np.ndarray]:
    """Three sizes by three rolls."""
    views = []
    for side, x, y in ((110, 40, 290), (190, 400, 40), (300, 180, 90)):
        for roll in (-20, 0, 20):
            view = scene.copy()
            part = Image.fromarray(tile).resize((side, side), Image.Resampling.LANCZOS).convert("RGBA")
            part = part.rotate(-roll, Image.Resampling.BICUBIC, expand=True)
            view.paste(part, (x, y), part)
            views.append(np.asarray(view))
    return views


def three(scene: Image.Image, tile: np.ndarray, eyes: Eyes) -> list[np.ndarray]:
    """As LFW, CelebA and UTKFace frame it, by eyes at (across, down) and their distance, of the side."""
    view = scene.copy()
    view.paste(Image.fromarray(tile).resize((256, 256), Image.Resampling.LANCZOS), (192, 112))
    left, right = eyes * 256 + (192, 112)
    middle, apart = (left + right) / 2, np.hypot(*(right - left))
    views = []
    for down, share in ((0.401, 0.330), (0.458, 0.304), (0.299, 0.394)):
        side = apart / share
        frame = Frame(middle[0], middle[1] + (0.5 - down) * side, side)
        views.append(np.ascontiguousarray(frame.cut(np.asarray(view), 128).transpose(1, 2, 0)))
    return views


def main() -> None:
    options = parser(__doc__)
    options.add_argument("--lfw", type=Path, required=True)
    options.add_argument("--utkface", type=Path, required=True)
    options.add_argument("--points", type=Path, required=True)
    options.add_argument("--half", choices=("first", "second"), default="second", help="of the people")
    options.add_argument("--pictures", type=int, default=200)
    options.add_argument("--crops", type=int, default=300)
    options.add_argument("--people", type=int, default=40, help="pictures that are shown in several framings")
    options.add_argument("--seed", type=int, default=0)
    options.add_argument("--only", help="names of detectors, with commas")
    chosen = options.parse_args()
    lfw = Faces(chosen.lfw, chosen.half, eyes_of_mesh(chosen.points))
    sets = [lfw, Faces(chosen.utkface, chosen.half)]
    detectors = {"find_faces": ours, "MTCNN": of_package, "LBP cascade": lbp()}
    if chosen.only:
        detectors = {name: detectors[name] for name in chosen.only.split(",")}
    result: dict = {"half": chosen.half, "seed": chosen.seed}
    for name, cases in (
        ("pasted", pasted(sets, chosen.pictures, chosen.seed)),
        ("lfw crops", crops(lfw, chosen.crops)),
    ):
        result[name] = scored(cases, detectors)
        for detector_name, row in result[name].items():
            numbers = ", ".join(
                f"{key} {value:.3f}" if isinstance(value, float) else f"{key} {value}"
                for key, value in row.items()
            )
            print(f"{name}, {detector_name}: {numbers}")
    result["framings"] = framings(lfw, chosen.people, chosen.seed)
    for name, row in result["framings"].items():
        print(name, {key: round(value, 3) for key, value in row.items()})
    publish(result, chosen.json)


if __name__ == "__main__":
    main()
