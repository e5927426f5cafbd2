"""`derender synth`: rendered images with exact depth, normals, albedo, parts, light and camera."""

from dataclasses import dataclass
from functools import partial
from typing import Annotated, Any

from typer import Option, Typer

from derender.cli import options
from derender.cli.console import progress_bar, result, write_json
from derender.cli.gathered import command


@dataclass(frozen=True)
class Request:
    """The options of both kinds of generated images."""

    out: options.OutFolder
    count: Annotated[int | None, Option("--count", "-n", min=1, help="Number of images (1000).")] = None
    image_size: Annotated[int, Option(min=16, max=1024, help="Width and height in pixels.")] = 64
    seed: options.Seed = 0
    light: Annotated[str, Option(help="Range of lighting: usual, wide, frontal.")] = "usual"
    view: Annotated[str, Option(help="Range of viewpoints: usual, wide, frontal.")] = "usual"
    truth: Annotated[bool, Option(help="Write the maps of ground truth too.")] = True
    overrides: options.Settings = None
    json_file: options.Json = None

    def generate(self, call: Any, count: int, objects: str, kind: Any, names: list[str], **own: Any) -> None:
        from derender.data.synthetic import named_settings, require_empty, write

        require_empty(self.out)
        settings = named_settings(kind, self.light, self.view, [*names, *(self.overrides or [])], **own)
        with progress_bar("generating") as report:
            made = call(count, self.image_size, self.seed, settings, report)
        with progress_bar("writing") as report:
            write(made, self.out, self.truth, report)
        different = len(set(made.identity.tolist()))
        result(f"{count:,} images of {different:,} {objects} in {self.out}", self.json_file)
        facts = {"count": count, objects: different, "image_size": self.image_size, "seed": self.seed}
        write_json(self.json_file, {"out": self.out, **facts, "settings": settings.model_dump(mode="json")})


@command("faces", "synth faces --out made/ --count 500 --light wide")
def faces(
    request: Request,
    identities: Annotated[int | None, Option(min=1, help="Number of people; default: 8 images each.")] = None,
    tracks: Annotated[int, Option(min=0, help="Number of sequences of each person, instead of images.")] = 0,
    frames: Annotated[int, Option(min=1, help="Number of images in a sequence.")] = 6,
    expressions: Annotated[str, Option(metavar="A,B", help="Only these expressions; default: all.")] = "",
    model: Annotated[str | None, Option(metavar="FILE", help="Morphable model (.npz) to use.")] = None,
) -> None:
    """Generate faces with ground truth; the folder reads back as data for training and for evaluation."""
    from derender.data.synthetic import FaceSettings, faces

    if tracks and request.count is not None:
        raise ValueError("--count does not go with --tracks: say --identities, --tracks and --frames")
    count = (identities or 12) * tracks * frames or request.count or 1000
    names = [f"expressions=[{expressions}]"] if expressions else []
    each = -(-count // identities) if identities and not tracks else FaceSettings().pictures_per_identity
    own = {"tracks": tracks, "frames": frames, "pictures_per_identity": each}
    request.generate(partial(faces.generate, model=model), count, "identities", FaceSettings, names, **own)


@command("cars", "synth cars --out made/ --classes police,jeep")
def cars(
    request: Request,
    classes: Annotated[str, Option(metavar="A,B", help="Only these classes; default: all twelve.")] = "",
) -> None:
    """Generate cars of twelve classes with ground truth; the folder reads back as the layout syncar."""
    from derender.data.synthetic import CarSettings, cars

    names = [f"classes=[{classes}]"] if classes else []
    request.generate(cars.generate, request.count or 1000, "models", CarSettings, names)


def register(app: Typer) -> None:
    group = Typer(help="Generate images of known geometry, albedo, light and camera.", no_args_is_help=True)
    for kind in (faces, cars):
        kind.register(group)
    app.add_typer(group, name="synth")
