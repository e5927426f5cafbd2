"""`derender synth`: rendered images with exact depth, normals, albedo, parts, light and camera."""

from typing import Any

from typer import Typer

from derender.cli.console import progress_bar, result, write_json
from derender.cli.options import GeneratedOptions, app, command, option
from derender.storage.places import counted

CLASSES = "Only these classes; default: all twelve."
group = Typer(help="Generate images of known geometry, albedo, light and camera.", no_args_is_help=True)
app.add_typer(group, name="synth")


def generate(
    request: GeneratedOptions, kind: str, count: int, objects: str, names: list[str],
    model: str | None = None, **own: Any,
) -> None:  # fmt: skip
    from derender.data import synthetic

    size, file = request.image_size, request.json_file
    if request.benchmark:
        alone = GeneratedOptions(request.out, image_size=size, benchmark=True, json_file=file)
        if request != alone or names or model or own:
            raise ValueError("--benchmark has settings of its own: only --image-size goes with it")
        with progress_bar("generating") as report:
            synthetic.write_benchmark(kind, request.out, size, report)
        result(f"the benchmark of generated {kind} in {request.out}", file)
        return
    settings = synthetic.named_settings(
        synthetic.KINDS[kind][1], request.light, request.view, [*names, *(request.overrides or [])], **own
    )
    with progress_bar("generating") as report:
        how = (size, request.seed, settings, request.truth, report, model)
        made = synthetic.write_generated(kind, request.out, count, *how)
    different = len(set(made.identity.tolist()))
    result(f"{counted(count, 'images')} of {counted(different, objects)} in {request.out}", file)
    facts = {"count": count, objects: different, "image_size": size, "seed": request.seed}
    write_json(file, {"out": request.out, **facts, "settings": settings.model_dump(mode="json")})


@command("faces", "synth faces --out made/ --count 500 --light wide", group)
def faces(
    request: GeneratedOptions,
    identities: int | None = option(None, "Number of people; default: 8 images each.", min=1),
    tracks: int = option(0, "Number of sequences of each person, instead of images.", min=0),
    frames: int = option(6, "Number of images in a sequence.", min=1),
    expressions: str = option("", "Only these expressions; default: all.", metavar="A,B"),
    model: str | None = option(None, "Morphable model (.npz) to use.", metavar="FILE"),
) -> None:
    """Generate faces with ground truth; the folder reads back as data for training and for evaluation."""
    if tracks and request.count is not None:
        raise ValueError("--count does not go with --tracks: say --identities, --tracks and --frames")
    count = (identities or 12) * tracks * frames or request.count or 1000
    names = [f"expressions=[{expressions}]"] if expressions else []
    own = {"tracks": tracks, "frames": frames} if tracks else {}
    own |= {"pictures_per_identity": -(-count // identities)} if identities and not tracks else {}
    generate(request, "faces", count, "identities", names, model, **own)


@command("cars", "synth cars --out made/ --classes police,jeep", group)
def cars(request: GeneratedOptions, classes: str = option("", CLASSES, metavar="A,B")) -> None:
    """Generate cars of twelve classes with ground truth; the folder reads back as the layout syncar."""
    names = [f"classes=[{classes}]"] if classes else []
    generate(request, "cars", request.count or 1000, "models", names)
