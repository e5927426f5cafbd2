"""The pictures that were opened last, taken apart: a bounded number, in memory only.

Each gets a name that cannot be guessed, so that one visitor cannot ask for another's. When the shelf is full
the picture goes that was not asked for longest.
"""

import secrets
import threading
from collections import OrderedDict
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import UInt8

from derender.report.viewer.refused import Refused
from derender.scene import Scene

KEPT = 64


@dataclass(frozen=True)
class TakenApart:
    """One picture and what the model found in it.

    Attributes:
        picture: the pixels at the model's size.
        scene: one scene, on the CPU.
        codes: its feature by factor, (D,) each.
        l1: mean absolute error of its reconstruction where the surface is seen, 0..1; best 0,
            infinite if it is seen nowhere.
    """

    picture: UInt8[np.ndarray, "3 s s"]
    scene: Scene
    codes: Mapping[str, np.ndarray]
    l1: float


class Shelf:
    """At most ``limit`` pictures by name; safe to use from several threads."""

    def __init__(self, limit: int = KEPT):
        if limit < 2:
            raise ValueError(f"a shelf needs room for 2 pictures or more, for swaps; got {limit}")
        self.limit = limit
        self._kept: OrderedDict[str, TakenApart] = OrderedDict()
        self._lock = threading.Lock()

    def __len__(self) -> int:
        return len(self._kept)

    def put(self, value: TakenApart) -> str:
        """Keep a picture; gives its name."""
        name = secrets.token_urlsafe(16)
        with self._lock:
            self._kept[name] = value
            while len(self._kept) > self.limit:
                self._kept.popitem(last=False)
        return name

    def get(self, name: str) -> TakenApart:
        """The picture of that name, which now counts as used; ``Refused`` (410) if it is no longer here."""
        with self._lock:
            if name not in self._kept:
                raise Refused(
                    410, f"this picture is no longer kept (the last {self.limit} are): open it again"
                )
            self._kept.move_to_end(name)
            return self._kept[name]
