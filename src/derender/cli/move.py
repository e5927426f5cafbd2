"""`derender relight`, `rotate` and `swap`: pictures in other lights, from other sides, with parts of another.

What is drawn lies in report/sweeps.py; how it lies on disk, in report/moved.py.
"""

from collections.abc import Callable
from math import ceil, degrees, log10
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from derender.cli import options
from derender.cli.console import progress_bar
from derender.cli.given import (
    Frame,
    Given,
    PictureFiles,
    PictureReader,
    Size,
    Texture,
    finish,
    given_pictures,
    percentiles,
    refining,
    scenes_of,
)

if TYPE_CHECKING:
    from torch import Tensor

    from derender.model import Derenderer
    from derender.report.moved import Moved
    from derender.scene import Scene

Count = Annotated[int, typer.Option("--stills", min=2, max=64, metavar="N", help="Pictures in the strip.")]
Film = Annotated[
    str, typer.Option("--film", help="gif, mp4, both with a comma between, or none.", metavar="KINDS")
]
Frames = Annotated[int, typer.Option("--frames", min=2, max=1000, metavar="N", help="Frames of the film.")]
Seconds = Annotated[float, typer.Option("--seconds", min=0.1, max=60, help="Length of the film.")]
DEFAULT_SIZE = 256


def register(app: typer.Typer) -> None:
    example = "Example: derender relight --model runs/faces me.jpg --like sunset.jpg --out relit/"
    app.command("relight", epilog=example)(relight)
    example = "Example: derender rotate --model runs/faces me.jpg --reach 45 --size 512 --out turned/"
    app.command("rotate", epilog=example)(rotate)
    example = "Example: derender swap --model runs/faces me.jpg --from you.jpg --factor albedo --out mixed/"
    app.command("swap", epilog=example)(swap)


def relight(
    images: PictureFiles,
    model: options.Model,
    out: options.OutFolder,
    like: Annotated[
        Path | None, typer.Option("--like", help="Go to the light of this picture.", metavar="IMAGE")
    ] = None,
    reach: Annotated[
        float, typer.Option("--reach", help="How far to the sides the light goes, in degrees.")
    ] = 60.0,
    pitch: Annotated[float, typer.Option("--pitch", help="Light from above, in degrees.")] = 10.0,
    strength: Annotated[
        float,
        typer.Option("--strength", min=0, max=10, help="How many times as strong as the picture's own."),
    ] = 1.0,
    stills: Count = 7,
    size: Size = DEFAULT_SIZE,
    texture: Texture = "model",
    fit_steps: options.FitSteps = None,
    frame: Frame = "whole",
    film: Film = "gif,mp4",
    frames: Frames = 48,
    seconds: Seconds = 4.0,
    device: options.Device = "auto",
    force: options.Force = False,
    json_file: options.Json = None,
) -> None:
    """Write strips and films of pictures in other lights: round from right to left, or to that of --like.

    A light is relative to the object, not to the camera: it falls on the same side of every face. Going
    round, it is as strong as the picture's own, a third of it from everywhere.
    """
    from derender.report import sweeps

    work = _Work(images, model, out, size, texture, film, device, force, fit_steps, frame)
    if like is None:
        before: dict[str, Any] = {}

        def lights(t: "Tensor", scene: "Scene") -> dict[str, "Tensor"]:
            own = float(scene.light[0, :2].sum())
            return {"light": sweeps.lights_around(t, reach, pitch, strength * own)}

        lights(sweeps.stills(2), work.scenes[0])  # angles out of range are refused before anything is drawn
    else:
        reference, before = work.other(like)

        def lights(t: "Tensor", scene: "Scene") -> dict[str, "Tensor"]:
            return {"light": sweeps.lights_between(t, scene.light[0], reference.light[0])}

    angle = _angles(reach, stills)

    def moved(scene: "Scene", own: dict[str, Any]) -> "Moved":
        def label(place: float, row: int, values: "Tensor") -> str:
            return f"light {angle(degrees(values[row, 3]))}" if like is None else f"{place:.0%} of its light"

        return _swept(work, scene, {**own, **before}, lights, label, stills, frames)

    work.write(moved, json_file, seconds)


def rotate(
    images: PictureFiles,
    model: options.Model,
    out: options.OutFolder,
    reach: Annotated[
        float, typer.Option("--reach", help="How far the object turns to either side, in degrees.")
    ] = 40.0,
    pitch: Annotated[float, typer.Option("--pitch", help="Nod: the top comes forward, in degrees.")] = 0.0,
    stills: Count = 7,
    size: Size = DEFAULT_SIZE,
    texture: Texture = "model",
    fit_steps: options.FitSteps = None,
    frame: Frame = "whole",
    film: Film = "gif,mp4",
    frames: Frames = 48,
    seconds: Seconds = 4.0,
    device: options.Device = "auto",
    force: options.Force = False,
    json_file: options.Json = None,
) -> None:
    """Write strips and films of pictures turned from one side to the other, in their own light."""
    from derender.report import sweeps

    work = _Work(images, model, out, size, texture, film, device, force, fit_steps, frame)

    def cameras(t: "Tensor", scene: "Scene") -> dict[str, "Tensor"]:
        return {"camera": sweeps.cameras_around(t, reach, pitch)}

    angle = _angles(reach, stills)

    def moved(scene: "Scene", own: dict[str, Any]) -> "Moved":
        def label(place: float, row: int, values: "Tensor") -> str:
            return f"yaw {angle(degrees(values[row, 1]))}"

        return _swept(work, scene, own, cameras, label, stills, frames)

    cameras(sweeps.stills(2), work.scenes[0])
    work.write(moved, json_file, seconds)


def swap(
    images: PictureFiles,
    model: options.Model,
    out: options.OutFolder,
    source: Annotated[Path, typer.Option("--from", help="The picture to take from.", metavar="IMAGE")],
    factor: Annotated[
        list[str] | None,
        typer.Option(
            "--factor", help="What to take; may be repeated. By default each in turn.", metavar="NAME"
        ),
    ] = None,
    size: Size = DEFAULT_SIZE,
    texture: Texture = "model",
    fit_steps: options.FitSteps = None,
    frame: Frame = "whole",
    device: options.Device = "auto",
    force: options.Force = False,
    json_file: options.Json = None,
) -> None:
    """Write pictures with one factor of another: its geometry, albedo, light or camera, each by itself."""
    from derender.features import named
    from derender.report.moved import Moved
    from derender.report.sweeps import drawn, swapped

    work = _Work(images, model, out, size, texture, "none", device, force, fit_steps, frame)
    parameters = {row.name: row.parameter for row in work.net.factors}
    wanted = {name: named(parameters, name, "factor") for name in factor or parameters}
    other, before = work.other(source)

    def moved(scene: "Scene", own: dict[str, Any]) -> Moved:
        images = {
            f"its {name}": drawn(swapped(scene, other, parameter), work.net.render)[0]
            for name, parameter in wanted.items()
        }
        numbers = {f"its {name}": {"factor": name, "from": str(source)} for name in wanted}
        return Moved({**own, **before}, images, numbers)

    work.write(moved, json_file, 1.0)


def _angles(reach_deg: float, stills: int) -> Callable[[float], str]:
    """How angles of a sweep are written, with as many decimals as it takes to tell its stills apart."""
    if reach_deg <= 0:
        raise ValueError(f"--reach must be above 0 degrees, got {reach_deg:g}")
    decimals = max(0, ceil(-log10(2 * reach_deg / (stills - 1))))

    def written(angle_deg: float) -> str:
        number = f"{angle_deg:+.{decimals}f}"
        return f"{number if float(number) else number[1:]}°"

    return written


class _Work:
    """One command's pictures, their scenes, and where they go."""

    def __init__(
        self,
        images: list[Path],
        model: str,
        out: Path,
        size: int,
        texture: str,
        film: str,
        device: str,
        force: bool,
        fit_steps: int | None,
        frame: str,
    ):
        from derender.cli.models import open_model
        from derender.report.moved import film_kinds

        self.films = film_kinds(film)
        self.out = out
        self.net: Derenderer = open_model(model, device)
        self.read = PictureReader(self.net, frame)
        self.refine = refining(self.read, size, texture, fit_steps, model)
        self.given: Given = given_pictures(images, self.read, out, force)
        self.scenes = scenes_of(self.net, self.given, 64)
        self.odd = percentiles(model, self.net, self.given.pictures)
        self.model = model

    def other(self, path: Path) -> "tuple[Scene, dict[str, Any]]":
        """The scene of a further picture, and the picture as a labelled image."""
        from derender.report.colours import pictures

        picture = self.read(path, self.net.image_size)
        (scene,) = scenes_of(self.net, Given({path: picture}, [], {}), 1)
        self.odd |= percentiles(self.model, self.net, {path: picture})
        return self._finer(scene, path), {"the other": pictures(picture[None])[0]}

    def write(self, moved: "Callable[[Scene, dict[str, Any]], Moved]", json_file: str | None, seconds: float):
        """Draw and write every picture, then the sheets over all of them."""
        from derender.report.colours import pictures
        from derender.report.moved import write_moved
        from derender.report.sheets import Sheets, write_sheets
        from derender.report.sweeps import drawn

        sheets, written = Sheets(), []
        with progress_bar("drawing") as report:
            report(0, len(self.scenes))
            for scene, folder, (path, picture) in zip(
                self.scenes, self.given.folders, self.given.pictures.items(), strict=True
            ):
                finer = self._finer(scene, path)
                own = {
                    "input": pictures(picture[None])[0],
                    "reconstruction": drawn(finer, self.net.render)[0],
                }
                made = moved(finer, own)
                written.append(write_moved(folder, made, {"picture": str(path)}, self.films, seconds))
                sheets.add(path.name, made.columns)
                report(len(written), len(self.scenes))
        paths = write_sheets(sheets, self.out) if len(sheets) > 1 else []
        finish(self.given, self.read, self.out, written, json_file, self.odd, sheets=paths)

    def _finer(self, scene: "Scene", path: Path) -> "Scene":
        return scene if self.refine is None else self.refine(scene, [path])


def _swept(
    work: _Work,
    scene: "Scene",
    before: dict[str, Any],
    values: "Callable[[Tensor, Scene], dict[str, Tensor]]",
    label: "Callable[[float, int, Tensor], str]",
    count: int,
    frames: int,
) -> "Moved":
    """Stills and film of one scene along a sweep of one parameter."""
    from derender.report import sweeps
    from derender.report.moved import Moved

    places = sweeps.stills(count)
    changed = values(places, scene)
    ((name, rows),) = changed.items()
    images = sweeps.drawn(sweeps.varied(scene, **changed), work.net.render)
    labels = [label(place, row, rows) for row, place in enumerate(places.tolist())]
    film = []
    if work.films:
        moving = sweeps.varied(scene, **values(sweeps.there_and_back(frames), scene))
        film = sweeps.drawn(moving, work.net.render)
    return Moved(
        before,
        dict(zip(labels, images, strict=True)),
        {text: {name: row} for text, row in zip(labels, rows.tolist(), strict=True)},
        film,
    )
