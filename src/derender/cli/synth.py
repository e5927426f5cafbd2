"""`derender synth`: rendered pictures with exact depth, normals, albedo, light and camera."""

from typing import Annotated

import typer

from derender.cli import options
from derender.cli.console import bar, result, say, write_json


def register(app: typer.Typer) -> None:
    group = typer.Typer(
        help="Make pictures whose geometry, albedo, light and camera are known.", no_args_is_help=True
    )
    group.command("faces", epilog="Example: derender synth faces --out made/ --count 500 --seed 1")(faces)
    app.add_typer(group, name="synth")


def faces(
    out: options.OutFolder,
    count: Annotated[
        int, typer.Option("--count", "-n", min=1, metavar="N", help="How many pictures.")
    ] = 1000,
    image_size: Annotated[
        int, typer.Option("--image-size", min=8, max=1024, metavar="N", help="Width and height in pixels.")
    ] = 64,
    seed: options.Seed = 0,
    json_file: options.Json = None,
) -> None:
    """Generate faces with ground truth; the folder reads back as data for training and for evaluation."""
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise FileExistsError(f"{out} exists and is not empty: choose another --out")
    from derender.data.synthetic import faces as generator
    from derender.data.synthetic import write

    with bar("generating") as report:
        made = generator.generate(count, image_size, seed, progress=report)
    say(f"writing to {out}")
    write(made, out)
    result(f"{count:,} faces in {out}", json_file)
    write_json(json_file, {"out": out, "count": count, "image_size": image_size, "seed": seed})
