"""`derender view`: the interactive page, served on this machine."""

import os
from importlib.util import find_spec
from pathlib import Path
from typing import Annotated

import typer

from derender.cli import options
from derender.cli.console import notice, result, write_json
from derender.cli.options import command, option
from derender.report.options import ImageOptions
from derender.storage.places import require_image

TABLE = "Table by derender embed, to search."
FRAME = "Part of each image: as for derender relight."
Named = Annotated[list[Path] | None, typer.Argument(help="Images to begin with.", metavar="[IMAGE]...")]


@command("view", "view --model rendered-faces-64 --port 8000")
def view(
    model: options.ImageModel, images: Named = None,
    features: Path | None = option(None, TABLE, "-f", "--features", metavar="FILE"),
    data: str | None = option(None, "Place of the table's images, if moved.", "-d", "--data", metavar="PATH"),
    dataset: options.Dataset = "auto",
    host: str = option("127.0.0.1", "Address to listen on; by default only this machine reaches it."),
    port: int = option(0, "Port to listen on; 0 takes any free one.", metavar="N"),
    keep: int = option(64, "Number of opened images in memory.", min=2, max=10_000),
    fit_steps: options.FitSteps = None,
    frame: str | None = option(None, FRAME, metavar="face|auto|none"),
    crop: str | None = option(None, None, hidden=True),
    json_file: options.Json = None,
) -> None:  # fmt: skip
    """Serve a page: drop an image, see its factors, drag light and camera, orbit, swap, search, save.

    It listens on this machine only, stores no image on disk, and needs no network. Ctrl-C ends it.
    """
    require_image(images or [])
    frame = ImageOptions(crop=crop, frame=frame).frame
    missing = [name for name in ("starlette", "uvicorn") if find_spec(name) is None]
    if missing:
        raise ValueError(f"the viewer needs {' and '.join(missing)}: pip install 'derender[view]'")
    from derender.report.viewer.server import address_of, is_loopback, listen, serve

    listener = listen(host, port)
    try:
        from derender.features import FeatureTable
        from derender.features.neighbours import maker_of
        from derender.report.viewer.app import Application, open_viewer

        loaded, table = model.open(), None
        if features is not None:
            table = FeatureTable.read(features)
            loaded = maker_of(table, loaded, str(features))
        studio, notes = open_viewer(
            loaded, model.model, images or [], table=table, data=data, dataset=dataset, keep=keep,
            fit_steps=fit_steps, frame=frame,
        )  # fmt: skip
        if not is_loopback(host):
            notes.append(f"warning: anyone who can reach {host} can use this page, and there is no password")
        notice(*notes)
        url, port = address_of(listener, host), listener.getsockname()[1]
        result(f"open {url} (Ctrl-C ends)", json_file)
        write_json(json_file, {"url": url, "host": host, "port": port, "model": model.model})
        serve(Application(studio, host), listener)
    except KeyboardInterrupt:  # where the shell has SIGINT ignored, the server ends without one
        notice("stopped")
        os._exit(0)  # the usual end of a process waits for the threads, and so for a running fit
    finally:
        listener.close()
    notice("stopped")
