"""Contact sheet of a search: the query, then the nearest images with their distances."""

from contextlib import suppress
from pathlib import Path

import numpy as np

from derender.data import Progress, Unreadable, decode, open_images, quiet_pillow, read_image
from derender.features.neighbours import Found
from derender.report.colours import pictures
from derender.report.page import png_bytes
from derender.report.panel import GridLayout, contact_sheet
from derender.storage.atomic import write_whole

CELL = 192


def search_sheet(
    result: Found,
    out: Path,
    images: str | None = None,
    *,
    dataset: str = "auto",
    progress: Progress | None = None,
) -> list[str]:
    """Write the sheet as PNG; gives the names of images that cannot be read and are left out of it.

    ``images`` is the address of the table's images, by default the one that the table records. ``dataset`` is
    their layout, or "auto". ``progress`` is called with (images read, all).

    Raises:
        ValueError: the address is not known, or holds none of the images.
    """
    address = images if images is not None else str(result.table.origin.get("data", ""))
    if not address:
        raise ValueError("the table does not record where its images are: give their address")
    captions = {result.table.files[row]: "query" for row in [result.own_row] if row is not None}
    for row, distance in zip(result.rows, result.distances, strict=True):
        captions.setdefault(result.table.files[row], f"{distance:.3f}")
    missing, read = set(captions), {}
    with open_images(address, dataset=dataset) as stream, quiet_pillow():
        for sample in stream.samples():
            if sample.file in missing:
                missing.remove(sample.file)
                with suppress(Unreadable, ValueError, OSError):
                    read[sample.file] = decode(sample.read(), CELL, box=sample.box)
                if progress is not None:
                    progress(len(read), len(captions))
            if not missing:
                break
    if not read:
        some = list(captions)[-1]
        raise ValueError(f"{address} holds none of the images found, such as {some!r}: give another address")
    shown = [] if result.own_row is not None else [("query", read_image(Path(result.like), CELL))]
    shown += [(caption, read[file]) for file, caption in captions.items() if file in read]
    names, drawn = [caption for caption, _ in shown], pictures(np.stack([image for _, image in shown]))
    title, layout = f"nearest by {result.factor}", GridLayout(cell=CELL)
    sheet = contact_sheet(drawn, names, across=7, title=title, layout=layout)
    write_whole(out, png_bytes(sheet))
    return [file for file in captions if file not in read]
