"""A running viewer with a small untrained model, and a client that behaves like its page."""

import http.client
import io
import json
from dataclasses import dataclass
from typing import Any
from urllib.parse import urlsplit

import numpy as np
import pytest
from PIL import Image

pytest.importorskip("starlette", reason="the viewer's packages are not installed: derender[view]")
pytest.importorskip("uvicorn", reason="the viewer's packages are not installed: derender[view]")

from tests.conftest import made_smallest
from tests.data.conftest import encode, noise
from tests.report.viewer.serving import serving

from derender import Derenderer
from derender.report.viewer.app import Application
from derender.report.viewer.images import Example
from derender.report.viewer.studio import Shelf, Studio

SIZE = 32


def _encoded(seed: int) -> bytes:
    """An image of coloured noise, as a file's bytes."""
    return encode(Image.fromarray(noise(seed, 6, 6)).resize((48, 40)))


@dataclass
class Reply:
    """What came back."""

    status: int
    headers: dict[str, str]
    body: bytes

    @property
    def json(self) -> Any:
        return json.loads(self.body)

    @property
    def error(self) -> str:
        return self.json["error"]

    @property
    def image(self) -> np.ndarray:
        return np.asarray(Image.open(io.BytesIO(self.body)).convert("RGBA"))


class Client:
    """Sends what the page sends; ``headers`` add to that or, where None, take away."""

    def __init__(self, url: str):
        self.url = url
        self.host = urlsplit(url).hostname or ""
        self.port = urlsplit(url).port or 0

    def __call__(
        self, method: str, path: str, body: object = None, headers: dict[str, str | None] | None = None
    ) -> Reply:
        sent: dict[str, str | None] = {"Host": f"{self.host}:{self.port}"}
        if method == "POST":
            sent |= {"X-Derender-Page": "1", "Origin": f"http://{self.host}:{self.port}"}
        sent |= headers or {}
        content = body if isinstance(body, bytes) or body is None else json.dumps(body).encode()
        connection = http.client.HTTPConnection(self.host, self.port, timeout=30)
        connection.putrequest(method, path, skip_host=True, skip_accept_encoding=True)
        for name, value in {**sent, "Content-Length": str(len(content or b""))}.items():
            if value is not None:
                connection.putheader(name, value)
        connection.endheaders(content)
        answer = connection.getresponse()
        headers = {name.lower(): value for name, value in answer.getheaders()}
        reply = Reply(answer.status, headers, answer.read())
        connection.close()
        return reply

    def get(self, path: str, **headers: str | None) -> Reply:
        return self("GET", path, None, headers)

    def post(self, path: str, body: object = None, headers: dict[str, str | None] | None = None) -> Reply:
        return self("POST", path, body, headers)

    def opened(self, seed: int = 0) -> dict[str, Any]:
        """What the server says of a new image."""
        reply = self.post("/api/pictures", _encoded(seed))
        assert reply.status == 200, reply.body
        return reply.json


@pytest.fixture(scope="session")
def model() -> Derenderer:
    """An untrained model of the smallest kind."""
    return made_smallest().eval().requires_grad_(False)


@pytest.fixture(scope="session")
def picture() -> np.ndarray:
    return np.random.default_rng(1).integers(0, 256, (SIZE, SIZE, 3), dtype=np.uint8)


@pytest.fixture(scope="session")
def client(model, picture):
    """A viewer with one example and room for four images."""
    studio = Studio(model, "<b>tiny</b>", Shelf(4), [Example("<img src=x>", picture)])
    with serving(Application(studio)) as url:
        yield Client(url)
