"""`derender synth`: rendered pictures with exact depth, normals, albedo, parts, light and camera."""

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, TypeVar

import typer

from derender.cli import options
from derender.cli.console import progress_bar, result, write_json

Kind = TypeVar("Kind")
ImageSize = Annotated[
    int, typer.Option("--image-size", min=16, max=1024, metavar="N", help="Width and height in pixels.")
]
Light = Annotated[
    str,
    typer.Option(
        "--light", help="Range of lights: usual, wide (outside of usual) or frontal.", metavar="NAME"
    ),
]
View = Annotated[
    str,
    typer.Option("--view", help="Range of views: usual, wide (outside of usual) or frontal.", metavar="NAME"),
]
Overrides = Annotated[
    list[str] | None,
    typer.Option(
        "--set", help="Change one setting, e.g. light.yaw_deg=[-60,60]; may be repeated.", metavar="KEY=VALUE"
    ),
]


def register(app: typer.Typer) -> None:
    group = typer.Typer(
        help="Make pictures whose geometry, albedo, light and camera are known.", no_args_is_help=True
    )
    group.command(
        "faces",
        epilog="Example: derender synth faces --out made/ --count 500 --seed 1 --light wide --view wide",
    )(faces)
    group.command(
        "cars", epilog="Example: derender synth cars --out made/ --count 500 --classes police,jeep,sports"
    )(cars)
    app.add_typer(group, name="synth")


def faces(
    out: options.OutFolder,
    count: Annotated[
        int | None,
        typer.Option("--count", "-n", min=1, metavar="N", help="How many pictures; default: 1000."),
    ] = None,
    image_size: ImageSize = 64,
    seed: options.Seed = 0,
    light: Light = "usual",
    view: View = "usual",
    identities: Annotated[
        int | None,
        typer.Option("--identities", min=1, metavar="N", help="How many people; default: 8 pictures each."),
    ] = None,
    tracks: Annotated[
        int,
        typer.Option("--tracks", min=0, metavar="N", help="Make sequences instead, so many of each person."),
    ] = 0,
    frames: Annotated[int, typer.Option("--frames", min=1, metavar="N", help="Pictures in a track.")] = 6,
    expressions: Annotated[
        str | None,
        typer.Option("--expressions", metavar="A,B", help="Only these expressions; default: all seven."),
    ] = None,
    model: Annotated[
        Path | None,
        typer.Option(
            "--model", metavar="FILE", help="A morphable model (.npz) instead of the built-in faces."
        ),
    ] = None,
    truth: Annotated[
        bool, typer.Option("--truth/--no-truth", help="Write the maps of ground truth too.")
    ] = True,
    overrides: Overrides = None,
    json_file: options.Json = None,
) -> None:
    """Generate faces with ground truth; the folder reads back as data for training and for evaluation."""
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise FileExistsError(f"{out} exists and is not empty: choose another --out")
    from derender.data.synthetic import LIGHTS, VIEWS, FaceSettings, MorphableFaces, write, write_tracks
    from derender.data.synthetic import faces as generator
    from derender.data.synthetic.overrides import changed
    from derender.storage.atomic import atomic_folder

    settings = FaceSettings(
        light=_named("--light", light, LIGHTS),
        view=_named("--view", view, VIEWS),
        tracks=tracks,
        frames=frames,
    )
    asked = [] if expressions is None else [f"expressions=[{expressions}]"]
    settings = changed(settings, [*asked, *(overrides or [])])
    if tracks:
        if count is not None:
            raise ValueError("--count does not go with --tracks: say --identities, --tracks and --frames")
        people = identities or 12
        count = people * settings.per_identity
    else:
        count = count or 1000
        if identities is not None:
            each = -(-count // identities)
            settings = changed(settings, [f"pictures_per_identity={each}"])
    source = None if model is None else MorphableFaces.read(model)
    with progress_bar("generating") as report:
        made = generator.generate(count, image_size, seed, settings, report, model=source)
    with progress_bar("writing") as report, atomic_folder(out) as folder:
        if tracks:
            write_tracks(made, folder, report)
        else:
            write(made, folder, truth, report)
    people = len(set(made.identity.tolist()))
    result(f"{count:,} faces of {people:,} people in {out}", json_file)
    facts = {"out": out, "count": count, "identities": people, "image_size": image_size, "seed": seed}
    write_json(json_file, facts | {"settings": settings.model_dump(mode="json")})


def cars(
    out: options.OutFolder,
    count: Annotated[
        int, typer.Option("--count", "-n", min=1, metavar="N", help="How many pictures.")
    ] = 1000,
    image_size: ImageSize = 64,
    seed: options.Seed = 0,
    light: Light = "usual",
    view: View = "usual",
    classes: Annotated[
        str | None,
        typer.Option("--classes", metavar="A,B", help="Only these classes of cars; default: all twelve."),
    ] = None,
    truth: Annotated[
        bool, typer.Option("--truth/--no-truth", help="Write the maps of ground truth too.")
    ] = True,
    overrides: Overrides = None,
    json_file: options.Json = None,
) -> None:
    """Generate cars of twelve classes with ground truth; the folder reads back as the layout syncar."""
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise FileExistsError(f"{out} exists and is not empty: choose another --out")
    from derender.data.synthetic import CAR_LIGHTS, CAR_VIEWS, CarSettings, write
    from derender.data.synthetic import cars as generator
    from derender.data.synthetic.overrides import changed
    from derender.storage.atomic import atomic_folder

    settings = CarSettings(light=_named("--light", light, CAR_LIGHTS), view=_named("--view", view, CAR_VIEWS))
    asked = [] if classes is None else [f"classes=[{classes}]"]
    settings = changed(settings, [*asked, *(overrides or [])])
    with progress_bar("generating") as report:
        made = generator.generate(count, image_size, seed, settings, report)
    with progress_bar("writing") as report, atomic_folder(out) as folder:
        write(made, folder, truth, report)
    models = len(set(made.identity.tolist()))
    result(f"{count:,} pictures of {models:,} cars in {out}", json_file)
    facts = {"out": out, "count": count, "models": models, "image_size": image_size, "seed": seed}
    write_json(json_file, facts | {"settings": settings.model_dump(mode="json")})


def _named(option: str, name: str, known: Mapping[str, Kind]) -> Kind:
    if name not in known:
        raise ValueError(f"{option} must be one of {', '.join(known)}, got {name!r}")
    return known[name]
