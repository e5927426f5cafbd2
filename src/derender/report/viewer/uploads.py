"""Bodies of requests as they arrive: within a bound of memory together, the slowest makes room."""

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field


@dataclass(eq=False)
class Body:
    """One body as it arrives: its kept content, all bytes received, and since when (a monotonic clock).

    ``whole``: nothing more will come. ``dropped``: it made room for others, and nothing of it is kept.
    """

    content: bytearray = field(default_factory=bytearray)
    received: int = 0
    whole: bool = False
    dropped: bool = False
    began_s: float = field(default_factory=time.monotonic)

    def take(self, part: bytes) -> None:
        self.received += len(part)
        if not self.dropped:
            self.content += part

    def drop(self) -> None:
        self.dropped = True
        self.content.clear()

    def speed(self, now_s: float) -> float:
        """Bytes a second since it began."""
        return self.received / max(now_s - self.began_s, 1e-6)


class Uploads:
    """The uploads that arrive or wait to be decoded: at most ``limit_bytes`` of them all, in memory only.

    No upload waits for another. Beyond the bound the slowest of those that still arrive is dropped, so that
    one that stalls or trickles does not hold up the others.
    """

    def __init__(self, limit_bytes: int):
        self.limit_bytes = limit_bytes
        self._bodies: set[Body] = set()

    @contextmanager
    def one(self) -> Iterator[Body]:
        """A body that counts meanwhile."""
        body = Body()
        self._bodies.add(body)
        try:
            yield body
        finally:
            self._bodies.remove(body)

    @property
    def kept_bytes(self) -> int:
        return sum(len(body.content) for body in self._bodies)

    def make_room(self) -> None:
        """Drop the slowest that still arrive until the others fit; to be called after every part."""
        while self.kept_bytes > self.limit_bytes:
            now_s = time.monotonic()
            arriving = [body for body in self._bodies if body.content and not body.whole]
            min(arriving, key=lambda body: body.speed(now_s)).drop()
