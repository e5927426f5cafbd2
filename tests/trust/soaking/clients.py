"""Clients that use a running viewer as its page does, all at once, and one that does what no browser would.

Each client opens images (uploads, examples, rows of the table), drags light and camera, swaps factors, asks
for neighbours, saves, and sometimes goes away without taking its answer. What comes back is looked at: kind,
content, and whether it belongs to the question. Leaves out who runs the server (../soak.py).
"""

import http.client
import io
import json
import random
import socket
import struct
import threading
import time
import zipfile
from collections import Counter
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

TIMEOUT_SECONDS = 60.0
ENDED_WITHIN_SECONDS = 50.0
"""Later than any of the server's own limits for heads, bodies and answers that nobody takes."""

PNG, GLB = b"\x89PNG\r\n\x1a\n", b"glTF"
FACTORS = ("geometry", "albedo", "light", "camera")
EXPORTS = ("picture", "panel", "mesh", "archive", "settings")
MAPS = {"input", "reconstruction", "view", "depth", "normals", "albedo", "shading"}


@dataclass
class Answers:
    """What all clients got, safe to use from several threads.

    Attributes:
        waits: seconds from question to whole answer, by kind of request.
        failures: by kind.
        said: the first sentences on what went wrong.
        held: odd connections that the server ended in time, by kind.
    """

    waits: dict[str, list[float]] = field(default_factory=dict)
    failures: Counter[str] = field(default_factory=Counter)
    said: list[str] = field(default_factory=list)
    held: Counter[str] = field(default_factory=Counter)
    lock: threading.Lock = field(default_factory=threading.Lock)
    _count_before: int = 0
    _longest: float = 0.0

    def got(self, kind: str, seconds: float) -> None:
        with self.lock:
            self.waits.setdefault(kind, []).append(seconds)
            self._longest = max(self._longest, seconds)

    def ended(self, kind: str) -> None:
        with self.lock:
            self.held[kind] += 1

    def since_last(self) -> tuple[int, float]:
        """How many answers there were since this was last asked, and the longest wait for one."""
        count = self.count
        with self.lock:
            found = count - self._count_before, self._longest
            self._count_before, self._longest = count, 0.0
        return found

    def failed(self, kind: str, why: str) -> None:
        with self.lock:
            self.failures[kind] += 1
            if len(self.said) < 20:
                self.said.append(f"{kind}: {why}")

    @property
    def count(self) -> int:
        with self.lock:
            return sum(map(len, self.waits.values()))

    def rows(self) -> list[dict[str, Any]]:
        """Per kind and for all: how many, failures, and waits in milliseconds."""
        with self.lock:
            waits = {kind: list(found) for kind, found in self.waits.items()}
        kinds = sorted(set(waits) | set(self.failures))
        every = [wait for found in waits.values() for wait in found]
        table = [(kind, waits.get(kind, []), self.failures[kind]) for kind in kinds]
        table.append(("all", every, sum(self.failures.values())))
        return [
            {
                "request": kind,
                "answers": len(found),
                "failed": failed,
                **{
                    f"p{share}_ms": 1000 * float(np.percentile(found or [0], share)) for share in (50, 95, 99)
                },
                "longest_ms": 1000 * max(found, default=0.0),
            }
            for kind, found, failed in table
        ]

    def markdown(self) -> str:
        lines = ["| request | answers | failed | median ms | 95 % | 99 % | longest |"]
        lines.append("| --- |" + " ---: |" * 6)
        for row in self.rows():
            waits = " | ".join(f"{row[key]:,.0f}" for key in ("p50_ms", "p95_ms", "p99_ms", "longest_ms"))
            lines.append(f"| {row['request']} | {row['answers']:,} | {row['failed']} | {waits} |")
        return "\n".join(lines)


class Unfit(Exception):
    """An answer that is not what was asked for."""


class Visitor(threading.Thread):
    """Somebody at the page: one session after another until told to stop.

    Args:
        port: of the viewer on this machine.
        number: tells visitors apart, and seeds what they do.
        uploads: encoded images.
        rows: in the viewer's table.
        pause_seconds: mean time between two requests.
        answers: where waits are noted.
        stop: ends the thread.
    """

    def __init__(
        self,
        port: int,
        number: int,
        uploads: Sequence[bytes],
        rows: int,
        pause_seconds: float,
        answers: Answers,
        stop: threading.Event,
    ):
        super().__init__(name=f"visitor {number}", daemon=True)
        self.port, self.uploads, self.rows = port, uploads, rows
        self.pause_seconds, self.answers, self.stop = pause_seconds, answers, stop
        self.draw = random.Random(number)
        self.line: http.client.HTTPConnection | None = None

    def run(self) -> None:
        while not self.stop.is_set():
            with suppress(Unfit):
                self.session()
            self.leave()
        self.leave()

    def leave(self) -> None:
        if self.line is not None:
            self.line.close()
            self.line = None

    def session(self) -> None:
        """Load the page, open an image or two, and play."""
        for path in ("/", "/view.css", "/view.js", "/surface.js"):
            self.ask("page", path, check=lambda body: len(body) > 100, method="GET")
        about = json.loads(
            self.ask("about", "/api/about", check=lambda body: b"examples" in body, method="GET")
        )
        examples = len(about["examples"])
        first, second = self.opened(examples), None
        for _ in range(self.draw.randrange(10, 40)):
            if self.stop.is_set():
                return
            chance = self.draw.random()
            question = self.question(first, second)
            if chance < 0.70:
                self.drag(question)
            elif chance < 0.78:
                self.ask(
                    "factors", "/api/factors", question, check=lambda body: set(json.loads(body)) == MAPS
                )
            elif chance < 0.86:
                more = {"factor": self.draw.choice(FACTORS), "k": 12}
                self.ask("neighbours", "/api/neighbours", {**question, **more}, check=_neighbours)
            elif chance < 0.92:
                name = self.draw.choice(EXPORTS)
                self.ask(name, f"/api/{name}", question, check=_export(name, question))
            elif chance < 0.95:
                second = self.opened(examples)
            elif chance < 0.97:
                self.ask("refused", "/api/pictures", b"no picture", check=None, status=415)
            else:
                self.abandon(question)

    def opened(self, examples: int) -> dict[str, Any]:
        """What the viewer says of an image from one of the three sources."""
        source = self.draw.choice(("upload", "upload", "example", "row"))
        path, body = {
            "upload": ("/api/pictures", self.draw.choice(self.uploads)),
            "example": (f"/api/examples/{self.draw.randrange(examples)}", {}),
            "row": (f"/api/rows/{self.draw.randrange(self.rows)}", {}),
        }[source]
        return json.loads(
            self.ask(source, path, body, check=lambda found: len(json.loads(found)["picture"]) == 22)
        )

    def question(self, first: dict[str, Any], second: dict[str, Any] | None) -> dict[str, Any]:
        """What the page sends: the image under some light and view, perhaps with another's factor."""
        draw = self.draw.uniform
        light = {
            "ambient": draw(0, 1),
            "diffuse": draw(0, 1),
            "pitch_deg": draw(-80, 80),
            "yaw_deg": draw(-80, 80),
        }
        camera = {
            "rotation_deg": [draw(-40, 40) for _ in range(3)],
            "translation": [draw(-0.1, 0.1) for _ in range(3)],
        }
        swaps = {} if second is None else {self.draw.choice(("geometry", "albedo")): second["picture"]}
        return {"picture": first["picture"], "swaps": swaps, "light": light, "camera": camera}

    def drag(self, question: dict[str, Any]) -> None:
        """One step of a slider, at the model's size or larger."""
        size = self.draw.choices((None, 128, 256), (90, 8, 2))[0]
        kind = "view" if size is None else f"view at {size}"
        self.ask(kind, "/api/view", {**question, "size": size}, check=lambda body: body.startswith(PNG))

    def abandon(self, question: dict[str, Any]) -> None:
        """Ask for something heavy and go away before it comes."""
        body = json.dumps(question).encode()
        with socket.create_connection(("127.0.0.1", self.port), TIMEOUT_SECONDS) as line:
            line.sendall(_head(self.port, "POST", "/api/archive", f"Content-Length: {len(body)}\r\n") + body)
            self.stop.wait(self.draw.uniform(0, 0.3))
        self.answers.ended("abandoned")
        self.leave()

    def ask(
        self,
        kind: str,
        path: str,
        body: object = None,
        *,
        check: Callable[[bytes], bool] | None,
        method: str = "POST",
        status: int = 200,
    ) -> bytes:
        """One request on the kept connection; notes the wait, or raises ``Unfit`` and notes why."""
        if self.stop.wait(self.draw.expovariate(1 / self.pause_seconds)):
            raise Unfit("it is over")
        content = body if isinstance(body, bytes) or body is None else json.dumps(body).encode()
        headers = (
            {} if method == "GET" else {"X-Derender-Page": "1", "Origin": f"http://127.0.0.1:{self.port}"}
        )
        began = time.monotonic()
        try:
            found, answer = self._exchange(method, path, content, headers)
        except (OSError, http.client.HTTPException) as problem:
            waited = f"{type(problem).__name__} {problem} after {time.monotonic() - began:.1f} s"
            if self.stop.is_set():  # the server may be gone already
                raise Unfit from problem
            self.answers.failed(kind, waited)
            raise Unfit from problem
        waited = time.monotonic() - began
        fits = found == status
        try:
            fits = fits and (check is None or check(answer))
        except (ValueError, LookupError, zipfile.BadZipFile):
            fits = False
        if not fits:
            self.answers.failed(kind, f"status {found} after {waited:.1f} s: {answer[:200]!r}")
            raise Unfit
        self.answers.got(kind, waited)
        return answer

    def _exchange(
        self, method: str, path: str, content: bytes | None, headers: dict[str, str]
    ) -> tuple[int, bytes]:
        """As browsers do: on the open connection, or on a new one where the server has ended that."""
        kept = self.line is not None
        if self.line is None:
            self.line = http.client.HTTPConnection("127.0.0.1", self.port, timeout=TIMEOUT_SECONDS)
        try:
            self.line.request(method, path, content, headers)
            answer = self.line.getresponse()
            return answer.status, answer.read()
        except (http.client.RemoteDisconnected, BrokenPipeError, ConnectionResetError):
            self.leave()
            if not kept:
                raise
            return self._exchange(method, path, content, headers)
        except BaseException:
            self.leave()
            raise


class Nuisance(threading.Thread):
    """Opens connections as no browser would, and looks whether the server ends them in time."""

    def __init__(self, port: int, pause_seconds: float, answers: Answers, stop: threading.Event):
        super().__init__(name="nuisance", daemon=True)
        self.port, self.pause_seconds, self.answers, self.stop = port, pause_seconds, answers, stop
        self.draw = random.Random(-1)
        self.held: list[tuple[float, str, socket.socket]] = []

    def run(self) -> None:
        while not self.stop.wait(self.draw.expovariate(1 / self.pause_seconds)):
            try:
                self.open(
                    self.draw.choice(
                        ("half a head", "slow body", "answers not taken", "silence", "reset", "noise")
                    )
                )
            except OSError as problem:
                self.answers.failed("half-open", f"cannot connect: {problem}")
            while self.held and time.monotonic() - self.held[0][0] > ENDED_WITHIN_SECONDS:
                self.look(*self.held.pop(0)[1:])
        for _, _, line in self.held:
            line.close()

    def open(self, kind: str) -> None:
        line = socket.socket()
        if kind == "answers not taken":
            line.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        line.settimeout(5)
        line.connect(("127.0.0.1", self.port))
        if kind == "half a head":
            line.sendall(_head(self.port, "GET", "/")[:-10])
        elif kind == "slow body":
            line.sendall(
                _head(self.port, "POST", "/api/pictures", "Content-Length: 1000000\r\n") + bytes(1000)
            )
        elif kind == "answers not taken":
            line.sendall(_head(self.port, "GET", "/view.js") * 40)
        elif kind == "noise":
            line.sendall(self.draw.randbytes(300) + b"\r\n\r\n")
        elif kind == "reset":
            line.sendall(_head(self.port, "GET", "/api/about"))
            line.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
            line.close()
            self.answers.ended(kind)
            return
        self.held.append((time.monotonic(), kind, line))

    def look(self, kind: str, line: socket.socket) -> None:
        """Whether the server has ended a connection: after what it had sent comes an end."""
        line.settimeout(1)
        try:
            while line.recv(1 << 20):
                pass
            self.answers.ended(kind)
        except TimeoutError:
            self.answers.failed("half-open", f"{kind} is still open after {ENDED_WITHIN_SECONDS:.0f} s")
        except OSError:  # reset: ended, too
            self.answers.ended(kind)
        finally:
            line.close()


def encoded(files: Sequence[Path]) -> list[bytes]:
    """Images as people have them: larger than the model's, in several formats."""
    found = []
    for number, file in enumerate(files):
        stream, side = io.BytesIO(), (64, 300, 1200)[number % 3]
        with Image.open(file) as picture:
            picture.resize((side, side * 3 // 4)).save(
                stream, format=("JPEG", "PNG", "WEBP", "TIFF")[number % 4]
            )
        found.append(stream.getvalue())
    return found


def _head(port: int, method: str, path: str, more: str = "") -> bytes:
    return f"{method} {path} HTTP/1.1\r\nHost: 127.0.0.1:{port}\r\nX-Derender-Page: 1\r\n{more}\r\n".encode()


def _neighbours(body: bytes) -> bool:
    rows = json.loads(body)["rows"]
    distances = [row["distance"] for row in rows]
    return len(rows) == 12 and distances == sorted(distances) and all(row["image"] for row in rows)


def _export(name: str, question: dict[str, Any]) -> Callable[[bytes], bool]:
    """Whether bytes are what was asked for; settings show that they belong to this question."""
    if name == "settings":
        return lambda body: json.loads(body)["light"] == question["light"]
    if name == "archive":
        return lambda body: zipfile.ZipFile(io.BytesIO(body)).testzip() is None
    return lambda body: body.startswith(GLB if name == "mesh" else PNG)
