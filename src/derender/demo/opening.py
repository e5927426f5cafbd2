"""The demo's first page: photographs edited by a bundled model, there before anything is trained.

Takes generated portraits, or those photographs of a user's folder in which a face is found. Leaves out
training and scores (``story``).
"""

import time
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path

import numpy as np
from jaxtyping import UInt8
from PIL import Image

from derender import __version__
from derender.data import read_images
from derender.data.synthetic import LIGHTS, VIEWS, FaceSettings, LightSettings, faces
from derender.model import load
from derender.photo import find_faces, open_photograph
from derender.report.page import Page

EDITOR = "faces-64"
"""The bundled model that knows photographs."""
SHOWN, EXAMINED, REFRESH_S, SEED = 4, 12, 10, 7
Photo = UInt8[np.ndarray, "h w 3"]


@dataclass(frozen=True)
class Opening:
    """Edited photographs: column name to JPEG files, one for each photograph, and where these come from."""

    columns: dict[str, list[bytes]]
    names: list[str]
    source: str


class LivePage:
    """The page of a running demo: the opening, progress, the newest samples; browsers reload it."""

    def __init__(self, file: Path, opening: Opening):
        self.file, self.opening = file, opening
        self.updated = float("-inf")

    def update(self, status: str, run: Path | None = None) -> None:
        """Write the page, at most every few seconds."""
        if time.monotonic() - self.updated < REFRESH_S:
            return
        samples = sorted((run / "samples").glob("*.png")) if run is not None else []
        sample = samples[-1].read_bytes() if samples else None
        values = {"opening": self.opening, "status": status, "sample": sample}
        lead = "Depth, lighting and viewpoint are predicted from one image each, without labels."
        footer = f"derender {__version__}"
        Page("demo_opening.html", "Images decomposed", lead, values, footer, REFRESH_S).write(self.file)
        self.updated = time.monotonic()


def opening(address: str | Path | None = None, side: int = 512) -> Opening:
    """Photographs relit, rotated, in the light of another; generated ones if no face is found."""
    shown, source = [], "generated portraits, which show no real person"
    if address is not None:
        read = read_images(address, side, limit=EXAMINED).images.transpose(0, 2, 3, 1)
        shown = [photo for photo in read if find_faces(photo)][:SHOWN]
    if shown:
        source = "your photographs"
    shown = shown or portraits(side)
    model = load(EDITOR)
    photos = [open_photograph(photo, model) for photo in shown]
    donors = [*photos[1:], photos[0]]
    columns = {
        "input": shown,
        "lit from the left, 60°": [photo.relit(60) for photo in photos],
        "lit from the right, 60°": [photo.relit(-60) for photo in photos],
        "rotated by 15°": [photo.rotated(15) for photo in photos],
        "in the light of the next": [
            photo.edited(light=donor.scene.light) for photo, donor in zip(photos, donors, strict=True)
        ],
    }
    names = [f"photograph {row + 1}" for row in range(len(shown))]
    return Opening({name: [_jpeg(one) for one in edited] for name, edited in columns.items()}, names, source)


def portraits(side: int) -> list[Photo]:
    """Generated heads of different people, lit from the front and, the last, from the side."""
    lights = [LIGHTS["frontal"]] * (SHOWN - 1) + [LightSettings(yaw_deg=(32, 32), pitch_deg=(20, 20))]
    made = []
    for row, light in enumerate(lights):
        settings = FaceSettings(
            light=light, view=VIEWS["frontal"], pictures_per_identity=1, expressions={"neutral": 1.0},
            backgrounds=("plain",),
        )  # fmt: skip
        made.append(faces.generate(1, side, SEED + row, settings=settings).images[0].transpose(1, 2, 0))
    return made


def _jpeg(photo: Photo) -> bytes:
    stream = BytesIO()
    Image.fromarray(np.ascontiguousarray(photo)).save(stream, "JPEG", quality=88)
    return stream.getvalue()
