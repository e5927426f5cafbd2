"""Clients that use a running viewer as its page does, all at once, and one that does what no browser would.

Each client opens images (uploads, examples, rows of the table), drags light and camera, swaps factors, asks
for neighbours, saves, and sometimes goes away without taking its answer. What comes back is looked at: kind,
content, and whether it belongs to the question.
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

PNG, JPEG, GLB = b"\x89PNG\r\n\x1a\n", b"\xff\xd8", b"glTF"
MAPS = {"input", "reconstruction", "depth", "normals", "albedo", "shading"}
Check = Callable[[bytes], bool]


@dataclass
class Answers:
    """What all clients got; lists are safe to append to from several threads.

    Attributes:
        waits: kind of request, and seconds to its whole answer.
        failures: kind, and what went wrong.
        ended: kinds of odd connections that the server ended in time.
    """

    waits: list[tuple[str, float]] = field(default_factory=list)
    failures: list[tuple[str, str]] = field(default_factory=list)
    ended: list[str] = field(default_factory=list)

    def told(self) -> dict[str, Any]:
        """How many answers and failures, and waits in milliseconds."""
        waits = [1000 * wait for _, wait in self.waits] or [0.0]
        shares = {f"p{share}_ms": float(np.percentile(waits, share)) for share in (50, 95, 99)}
        slowest = max(self.waits, key=lambda one: one[1], default=("none", 0.0))[0]
        counts = {"answers": len(self.waits), "failed": len(self.failures)}
        return {**counts, **shares, "longest_ms": max(waits), "slowest": slowest}


class Unfit(Exception):
    """An answer that is not what was asked for, or the end of the load."""


@dataclass
class Visitor:
    """Somebody at the page: one session after another until told to stop.

    Attributes:
        port: of the viewer on this machine.
        number: tells visitors apart, and seeds what they do.
        uploads: encoded images.
        rows: in the viewer's table.
        pause_seconds: mean time between two requests.
        answers: where waits are noted.
        stop: ends it.
    """

    port: int
    number: int
    uploads: Sequence[bytes]
    rows: int
    pause_seconds: float
    answers: Answers
    stop: threading.Event
    line: http.client.HTTPConnection | None = None

    def __post_init__(self) -> None:
        self.draw = random.Random(self.number)

    def run(self) -> None:
        while not self.stop.is_set():
            with suppress(Unfit):
                self.session()
            self.leave()

    def leave(self) -> None:
        if self.line is not None:
            self.line.close()
        self.line = None

    def session(self) -> None:
        """Load the page, open an image or two, and play."""
        for path in ("/", "/view.css", "/view.js", "/surface.js"):
            self.ask("page", path, fits=lambda body: len(body) > 100, method="GET")
        about = self.ask("about", "/api/about", fits=lambda body: b"examples" in body, method="GET")
        examples = len(json.loads(about)["examples"])
        first, swaps = self.opened(examples), {}
        for _ in range(self.draw.randrange(10, 40)):
            question = self.question(first, swaps)
            weights = {"drag": 70, "factors": 8, "neighbours": 8, "save": 6, "open": 3, "refused": 2, "go": 3}
            match self.draw.choices(list(weights), list(weights.values()))[0]:
                case "drag":
                    self.drag(question)
                case "factors":
                    self.ask("factors", "/api/factors", question, lambda body: set(json.loads(body)) == MAPS)
                case "neighbours":
                    asked = {"factor": self.draw.choice(("geometry", "albedo", "light", "camera")), "k": 12}
                    self.ask("neighbours", "/api/neighbours", {**question, **asked}, nearest_first)
                case "save":
                    name = self.draw.choice(("picture", "panel", "mesh", "archive", "settings"))
                    self.ask(name, f"/api/{name}", question, export(name, question))
                case "open":
                    swaps = {self.draw.choice(("geometry", "albedo")): self.opened(examples)}
                case "refused":
                    self.ask("refused", "/api/pictures", b"no picture", status=415)
                case "go":
                    self.abandon(question)

    def opened(self, examples: int) -> str:
        """The viewer's name of an image from one of the three sources."""
        source = self.draw.choice(("upload", "upload", "example", "row"))
        path, body = {
            "upload": ("/api/pictures", self.draw.choice(self.uploads)),
            "example": (f"/api/examples/{self.draw.randrange(examples)}", {}),
            "row": (f"/api/rows/{self.draw.randrange(self.rows)}", {}),
        }[source]
        told = self.ask(source, path, body, lambda found: len(json.loads(found)["picture"]) == 22)
        return json.loads(told)["picture"]

    def question(self, picture: str, swaps: dict[str, str]) -> dict[str, Any]:
        """What the page sends: the image under some light and view, perhaps with another's factor."""
        draw = self.draw.uniform
        light = {"ambient": draw(0, 1), "diffuse": draw(0, 1)}
        light |= {"pitch_deg": draw(-80, 80), "yaw_deg": draw(-80, 80)}
        turned, moved = [draw(-40, 40) for _ in range(3)], [draw(-0.1, 0.1) for _ in range(3)]
        camera = {"rotation_deg": turned, "translation": moved}
        return {"picture": picture, "swaps": swaps, "light": light, "camera": camera}

    def drag(self, question: dict[str, Any]) -> None:
        """One step of a slider, at the model's size or larger."""
        size = self.draw.choices((None, 128, 256), (90, 8, 2))[0]
        kind = "view" if size is None else f"view at {size}"
        self.ask(kind, "/api/view", {**question, "size": size}, lambda body: body.startswith(JPEG))

    def abandon(self, question: dict[str, Any]) -> None:
        """Ask for something heavy and go away before it comes."""
        body = json.dumps(question).encode()
        with socket.create_connection(("127.0.0.1", self.port), TIMEOUT_SECONDS) as line:
            line.sendall(head(self.port, "POST", "/api/archive", len(body)) + body)
            self.stop.wait(self.draw.uniform(0, 0.3))
        self.answers.ended.append("abandoned")

    def ask(
        self, kind: str, path: str, body: object = None, fits: Check = lambda _: True, *,
        method: str = "POST", status: int = 200,
    ) -> bytes:  # fmt: skip
        """One request on the kept connection; notes the wait, or raises ``Unfit`` and notes why."""
        if self.stop.wait(self.draw.expovariate(1 / self.pause_seconds)):
            raise Unfit
        content = body if isinstance(body, bytes) or body is None else json.dumps(body).encode()
        began = time.monotonic()
        try:
            found, answer = self.exchange(method, path, content)
        except (OSError, http.client.HTTPException) as problem:
            if not self.stop.is_set():  # else the server may be gone already
                self.answers.failures.append((kind, f"{type(problem).__name__} {problem}"))
            raise Unfit from problem
        waited, well = time.monotonic() - began, False
        with suppress(ValueError, LookupError, zipfile.BadZipFile):
            well = found == status and fits(answer)
        if not well:
            self.answers.failures.append((kind, f"status {found} after {waited:.1f} s: {answer[:200]!r}"))
            raise Unfit
        self.answers.waits.append((kind, waited))
        return answer

    def exchange(self, method: str, path: str, content: bytes | None) -> tuple[int, bytes]:
        """As browsers do: on the open connection, or on a new one where the server has ended that."""
        headers = {"X-Derender-Page": "1", "Origin": f"http://127.0.0.1:{self.port}"}
        kept = self.line is not None
        self.line = self.line or http.client.HTTPConnection("127.0.0.1", self.port, timeout=TIMEOUT_SECONDS)
        try:
            self.line.request(method, path, content, headers if method == "POST" else {})
            answer = self.line.getresponse()
            return answer.status, answer.read()
        except (http.client.RemoteDisconnected, BrokenPipeError, ConnectionResetError):
            self.leave()
            if not kept:
                raise
            return self.exchange(method, path, content)
        except BaseException:
            self.leave()
            raise


def nuisance(port: int, pause_seconds: float, answers: Answers, stop: threading.Event) -> None:
    """Open connections as no browser would, and look whether the server ends them in time."""
    draw, held = random.Random(-1), []
    sent = {
        "half a head": head(port, "GET", "/")[:-10],
        "slow body": head(port, "POST", "/api/pictures", 1_000_000) + bytes(1000),
        "answers not taken": head(port, "GET", "/view.js") * 40,
        "silence": b"",
        "noise": draw.randbytes(300) + b"\r\n\r\n",
        "reset": head(port, "GET", "/api/about"),
    }
    while not stop.wait(draw.expovariate(1 / pause_seconds)):
        kind, line = draw.choice(list(sent)), socket.socket()
        line.settimeout(5)
        try:
            if kind == "answers not taken":
                line.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
            line.connect(("127.0.0.1", port))
            line.sendall(sent[kind])
            if kind == "reset":
                line.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
                line.close()
                answers.ended.append(kind)
            else:
                held.append((time.monotonic(), kind, line))
        except OSError as problem:
            answers.failures.append(("half-open", f"cannot connect: {problem}"))
        while held and time.monotonic() - held[0][0] > ENDED_WITHIN_SECONDS:
            look(*held.pop(0)[1:], answers)
    for _, _, line in held:
        line.close()


def look(kind: str, line: socket.socket, answers: Answers) -> None:
    """Whether the server has ended a connection: after what it had sent comes an end, or a reset."""
    line.settimeout(1)
    with line:
        try:
            while line.recv(1 << 20):
                pass
        except TimeoutError:
            text = f"{kind} is still open after {ENDED_WITHIN_SECONDS:.0f} s"
            answers.failures.append(("half-open", text))
            return
        except OSError:
            pass
    answers.ended.append(kind)


def encoded(files: Sequence[Path]) -> list[bytes]:
    """Images as people have them: larger than the model's, in several formats."""
    found = []
    for number, file in enumerate(files):
        stream, side = io.BytesIO(), (64, 300, 1200)[number % 3]
        with Image.open(file) as picture:
            resized = picture.resize((side, side * 3 // 4))
        resized.save(stream, format=("JPEG", "PNG", "WEBP", "TIFF")[number % 4])
        found.append(stream.getvalue())
    return found


def head(port: int, method: str, path: str, length: int | None = None) -> bytes:
    more = "" if length is None else f"Content-Length: {length}\r\n"
    return f"{method} {path} HTTP/1.1\r\nHost: 127.0.0.1:{port}\r\nX-Derender-Page: 1\r\n{more}\r\n".encode()


def nearest_first(body: bytes) -> bool:
    rows = json.loads(body)["rows"]
    distances = [row["distance"] for row in rows]
    return len(rows) == 12 and distances == sorted(distances) and all(row["image"] for row in rows)


def export(name: str, question: dict[str, Any]) -> Check:
    """Whether bytes are what was asked for; settings show that they belong to this question."""
    if name == "settings":
        return lambda body: json.loads(body)["light"] == question["light"]
    if name == "archive":
        return lambda body: zipfile.ZipFile(io.BytesIO(body)).testzip() is None
    return lambda body: body.startswith(GLB if name == "mesh" else PNG)
