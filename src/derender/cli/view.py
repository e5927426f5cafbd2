"""`derender view`: the interactive page, served on this machine."""

from importlib.util import find_spec
from pathlib import Path
from typing import Annotated

import typer

from derender.cli import options
from derender.cli.console import notice, result, write_json
from derender.cli.gathered import command
from derender.report.opening import ImageOptions
from derender.storage.places import require_image

Named = Annotated[list[Path] | None, typer.Argument(help="Images to begin with.", metavar="[IMAGE]...")]
Features = Annotated[
    Path | None, typer.Option("-f", "--features", help="Table by derender embed, to search.", metavar="FILE")
]
TableData = Annotated[
    str | None, typer.Option("-d", "--data", help="Place of the table's images, if moved.", metavar="PATH")
]
Host = Annotated[str, typer.Option(help="Address to listen on; by default only this machine reaches it.")]
Port = Annotated[int, typer.Option(help="Port to listen on; 0 takes any free one.", metavar="N")]
Keep = Annotated[int, typer.Option(min=2, max=10_000, help="Number of opened images in memory.")]
FRAME = "Part of each image: as for derender relight."
Frame = Annotated[str | None, typer.Option(help=FRAME, metavar="face|auto|none")]
Crop = Annotated[str | None, typer.Option("--crop", hidden=True)]


@command("view", "view --model rendered-faces-64 --port 8000")
def view(
    model: options.TrainedModel, images: Named = None, features: Features = None, data: TableData = None,
    dataset: options.Dataset = "auto", host: Host = "127.0.0.1", port: Port = 0, keep: Keep = 64,
    fit_steps: options.FitSteps = None, frame: Frame = None, crop: Crop = None,
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
    from derender.report.viewer.server import address_of, listen, serve

    listener = listen(host, port)
    try:
        from derender.features import FeatureTable
        from derender.features.neighbours import maker_of
        from derender.report.viewer.app import Application, open_viewer
        from derender.report.viewer.guard import is_loopback

        loaded, table = model.open(), None
        if features is not None:
            table = FeatureTable.read(features)
            loaded = maker_of(table, loaded, str(features))
        viewer, notes = open_viewer(
            loaded, model.model, images or [], table=table, data=data, dataset=dataset, keep=keep,
            fit_steps=fit_steps or 0, frame=frame,
        )  # fmt: skip
        if not is_loopback(host):
            notes.append(f"warning: anyone who can reach {host} can use this page, and there is no password")
        for note in notes:
            notice(note)
        url, port = address_of(listener, host), listener.getsockname()[1]
        result(f"open {url} (Ctrl-C ends)", json_file)
        write_json(json_file, {"url": url, "host": host, "port": port, "model": model.model})
        serve(Application(viewer, host), listener)
    except KeyboardInterrupt:  # where the shell has SIGINT ignored, the server ends without one
        pass
    finally:
        listener.close()
    notice("stopped")
