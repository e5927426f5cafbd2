"""`derender view`: the page one can play with, served on this machine."""

from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from derender.cli import options
from derender.cli.console import notice, result, write_json
from derender.report.opening import ImageOptions

if TYPE_CHECKING:
    import numpy as np

    from derender.model import Derenderer
    from derender.report.viewer.neighbours import Gallery
    from derender.training.held_out_errors import HeldOutErrors

NEEDED = ("starlette", "uvicorn")


def register(app: typer.Typer) -> None:
    app.command("view", epilog="Example: derender view --model rendered-faces-64 --port 8000")(view)


def view(
    model: options.Model,
    images: Annotated[
        list[Path] | None, typer.Argument(help="Pictures to begin with.", metavar="[IMAGE]...")
    ] = None,
    features: Annotated[
        Path | None,
        typer.Option(
            "--features", "-f", help="A table by derender embed: nearest neighbours.", metavar="FILE.parquet"
        ),
    ] = None,
    data: Annotated[
        str | None,
        typer.Option(
            "--data", "-d", help="Where the table's pictures lie, if no longer where it says.", metavar="PATH"
        ),
    ] = None,
    dataset: options.Dataset = "auto",
    host: Annotated[
        str,
        typer.Option(
            "--host", help="Address to listen on; others can reach any but this one.", metavar="ADDRESS"
        ),
    ] = "127.0.0.1",
    port: Annotated[
        int, typer.Option("--port", help="Port to listen on; 0 takes any free one.", metavar="N")
    ] = 0,
    keep: Annotated[
        int, typer.Option("--keep", min=2, max=10_000, help="Opened pictures held in memory.", metavar="N")
    ] = 64,
    fit_steps: options.FitSteps = None,
    crop: Annotated[
        str,
        typer.Option(
            "--crop",
            help="auto: the part of each image that the model reconstructs best.",
            metavar="whole|auto",
        ),
    ] = "whole",
    frame: Annotated[str | None, typer.Option("--frame", hidden=True)] = None,
    device: options.Device = "auto",
    json_file: options.Json = None,
) -> None:
    """Serve a page: drop a picture, see its factors, drag light and camera, orbit, swap, search, save.

    It listens on this machine only, keeps no picture on disk, and needs no network. Ctrl-C ends it.
    """
    _check_installed()
    cropped = ImageOptions(crop=crop, frame=frame).cropped
    from derender.report.viewer.listener import address_of, listen

    listener = listen(host, port)
    try:
        from derender.cli.models import fitting_of, open_model
        from derender.report.viewer.app import Application, Viewer
        from derender.report.viewer.examples import named_examples, rendered_examples
        from derender.report.viewer.guard import is_loopback
        from derender.report.viewer.server import serve
        from derender.report.viewer.shelf import Shelf
        from derender.report.viewer.studio import Studio, reading_size

        net = open_model(model, device)
        if fit_steps:
            fitting_of(net, model)
        pictures = _readable(images or [], reading_size(net, cropped))
        gallery = None
        if features is not None:
            gallery, net = _gallery(features, data, dataset, model, net)
        examples = named_examples(pictures) if images else rendered_examples(model, net.image_size)
        table = None if gallery is None else gallery.table
        studio = Studio(net, Path(model).name, Shelf(keep), _held_out(model), table, fit_steps or 0, cropped)
        url = address_of(listener, host)
        if not is_loopback(host):
            notice(f"warning: anyone who can reach {host} can use this page, and there is no password")
        result(f"open {url} (Ctrl-C ends)", json_file)
        write_json(json_file, {"url": url, "host": host, "port": listener.getsockname()[1], "model": model})
        serve(Application(Viewer(studio, examples, gallery), host), listener)
    except KeyboardInterrupt:  # where the shell has SIGINT ignored, the server ends without one
        pass
    finally:
        listener.close()
    notice("stopped")


def _check_installed() -> None:
    missing = [name for name in NEEDED if find_spec(name) is None]
    if missing:
        raise ValueError(f"the viewer needs {' and '.join(missing)}: pip install 'derender[view]'")


def _readable(images: list[Path], size: int) -> "dict[Path, np.ndarray]":
    """The pictures that can be read; those that cannot are named."""
    from derender.report.opening import read_file

    read, problems = {}, {}
    for path in dict.fromkeys(images):
        try:
            read[path] = read_file(path, size)
        except (ValueError, OSError) as problem:
            problems[path] = " ".join(str(problem).split())
    if problems and not read:
        raise ValueError(next(iter(problems.values())))
    for path, reason in problems.items():
        notice(f"left out {path}: {reason}")
    return read


def _gallery(
    features: Path, data: str | None, dataset: str, model: str, net: "Derenderer"
) -> "tuple[Gallery, Derenderer]":
    """The table, if this model made it, and the model with its steps of fitting."""
    from derender.cli.models import check_maker
    from derender.features import FeatureTable
    from derender.report.viewer.neighbours import Gallery

    table = FeatureTable.read(features)
    net = check_maker(net, model, table, features)
    if not set(table.factors) & set(net.nets):
        raise ValueError(f"{features} has none of the factors of {model}: make it again with derender embed")
    gallery = Gallery(table, data, dataset)
    if gallery.without_pictures:
        notice(f"neighbours are shown without pictures: {gallery.without_pictures}")
    return gallery, net


def _held_out(model: str) -> "HeldOutErrors | None":
    """The errors stored with the model; None where there are none or they are damaged."""
    from derender.storage.folder import model_folder
    from derender.training.held_out_errors import read_errors

    try:
        return read_errors(model_folder(model))
    except (ValueError, OSError) as problem:
        notice(f"cannot tell odd pictures: {problem}")
        return None
