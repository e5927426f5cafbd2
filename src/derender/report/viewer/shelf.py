"""Opened images, kept in memory only: a bounded number of them, and of bytes."""

import secrets
import threading
from collections import OrderedDict
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import UInt8

from derender.photo import Frame
from derender.report.viewer.questions import Refused
from derender.scene import Scene

KEPT = 64
KEPT_BYTES = 400_000_000
"""Of photographs together."""


@dataclass(frozen=True)
class ShownImage:
    """One opened image."""

    photo: UInt8[np.ndarray, "h w 3"]  # the photograph, its longer side at most ``studio.LARGEST_PHOTO``
    faces: tuple[Frame, ...]  # the frames of the faces found in it
    frame: Frame  # the part that the model was given
    framed: str  # how that was found: "face", "auto", "none", "no face" or "own"
    pixels: UInt8[np.ndarray, "3 s s"]  # that part at the model's size
    scene: Scene  # one scene, on the CPU
    features: Mapping[str, np.ndarray]  # by factor, (D,) each


class Shelf:
    """Opened images by names that cannot be guessed: at most ``limit``, and ``limit_bytes`` of photographs.

    When it is full, the image leaves that was not requested for longest; the last two stay. Safe to use from
    several threads.
    """

    def __init__(self, limit: int = KEPT, limit_bytes: int = KEPT_BYTES):
        if limit < 2:
            raise ValueError(f"a shelf needs room for 2 images or more, for swaps; got {limit}")
        self.limit, self.limit_bytes = limit, limit_bytes
        self._images: OrderedDict[str, ShownImage] = OrderedDict()
        self._lock = threading.Lock()

    def __len__(self) -> int:
        return len(self._images)

    def put(self, image: ShownImage) -> str:
        """Store an image; returns its name."""
        name = secrets.token_urlsafe(16)
        with self._lock:
            self._images[name] = image
            while len(self._images) > self.limit or (
                len(self._images) > 2 and self._kept_bytes() > self.limit_bytes
            ):
                self._images.popitem(last=False)
        return name

    def _kept_bytes(self) -> int:
        return sum({id(image.photo): image.photo.nbytes for image in self._images.values()}.values())

    def get(self, name: str) -> ShownImage:
        """The image of that name, which now counts as used; ``Refused`` (410) if it has left."""
        with self._lock:
            if name not in self._images:
                raise Refused(
                    410, f"this image is no longer stored (the last {self.limit} are): open it again"
                )
            self._images.move_to_end(name)
            return self._images[name]
