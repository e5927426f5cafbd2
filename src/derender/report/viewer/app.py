"""The addresses of the page and their answers, within bounds of size, time and number.

Nothing in a request can name a file: the page's own files are read once at the start, images are known by
names that the shelf made up, examples and rows by number. Bodies are read up to a limit, and all uploads
together keep no more than another; decoding and computing have one thread each, so that a heavy upload does
not hold up the sliders of others.
"""

import asyncio
import json
import time
from collections.abc import Awaitable, Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import partial
from importlib.resources import files
from pathlib import Path
from typing import Any

from starlette.applications import Starlette
from starlette.exceptions import HTTPException
from starlette.requests import ClientDisconnect, Request
from starlette.responses import JSONResponse, Response
from starlette.routing import Route

from derender import __version__
from derender.data import read_photo
from derender.features import FeatureTable
from derender.inputs import require_fitting
from derender.model import Derenderer
from derender.report.colours import pictures
from derender.report.opening import held_out_errors, readable
from derender.report.viewer.guard import Guard
from derender.report.viewer.neighbours import Example, Gallery, named_examples, rendered_examples
from derender.report.viewer.questions import (
    BODY_LIMIT_BYTES,
    LARGEST_SIZE,
    PIXEL_LIMIT,
    NeighbourRequest,
    Q,
    Refused,
    ViewRequest,
    photo_of,
    read_request,
    too_large,
)
from derender.report.viewer.studio import KEPT, Shelf, Studio, data_url

BODY_SECONDS = 30.0
WORK_SECONDS = 30.0
REQUEST_LIMIT_BYTES = 10_000
UPLOADS_LIMIT_BYTES = 10 * BODY_LIMIT_BYTES
"""Of all uploads together that arrive or wait to be decoded."""

WAITING_AT_MOST = 200
DRAINED_AT_MOST_BYTES = 3 * BODY_LIMIT_BYTES
"""So much of a body that is too large is still read and dropped, so that browsers see the answer."""

THUMBNAIL = 64
PAGE_FILES = {
    "/": ("index.html", "text/html"),
    "/view.css": ("view.css", "text/css"),
    "/view.js": ("view.js", "text/javascript"),
    "/surface.js": ("surface.js", "text/javascript"),
}


@dataclass
class Viewer:
    """A model, images to begin with, and rows to find neighbours among."""

    studio: Studio
    examples: Sequence[Example] = ()
    gallery: Gallery | None = None


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


def open_viewer(
    model: Derenderer,
    source: str,
    images: Sequence[Path] = (),
    *,
    table: FeatureTable | None = None,
    data: str | None = None,
    dataset: str = "auto",
    keep: int = KEPT,
    fit_steps: int = 0,
    frame: str | None = None,
) -> tuple[Viewer, list[str]]:
    """A model with images to begin with and rows to search, and notes on what is missing.

    Args:
        model: trained.
        source: where it was loaded from.
        images: image files to begin with; without any, rendered ones for the bundled models.
        table: features made by this model, for nearest neighbours.
        data: place of the table's images, if not as the table records it.
        dataset: layout of that place.
        keep: opened images held in memory.
        fit_steps: of test-time optimisation of each scene.
        frame: how the part of each image is found that the model is given (``photo.found_frame``).
    """
    if fit_steps:
        require_fitting(model, source)
    gallery = None
    if table is not None:
        if not set(table.factors) & set(model.nets):
            raise ValueError(
                f"the table has none of the factors of {source}: make it again with derender embed"
            )
        gallery = Gallery(table, data, dataset)
    studio = Studio(model, Path(source).name, Shelf(keep), held_out_errors(source), table, fit_steps, frame)
    read, problems = readable(images, read_photo)
    notes = [f"left out {path}: {reason}" for path, reason in problems.items()]
    if gallery is not None and gallery.without_pictures:
        notes.append(f"neighbours are shown without images: {gallery.without_pictures}")
    examples = named_examples(read) if images else rendered_examples(source, model.image_size)
    return Viewer(studio, examples, gallery), notes


Answer = Callable[[Request], Awaitable[Response]]


class Application:
    """The answers, and the threads that work them out; an ASGI application as ``guarded``.

    Args:
        viewer: the content.
        host: the address that the server listens on.
        body_seconds: within which a body has to arrive.
        work_seconds: within which an answer has to be there, waiting for others included.
    """

    def __init__(
        self,
        viewer: Viewer,
        host: str = "127.0.0.1",
        body_seconds: float = BODY_SECONDS,
        work_seconds: float = WORK_SECONDS,
    ):
        self.viewer = viewer
        self.body_seconds, self.work_seconds = body_seconds, work_seconds
        self._computing = ThreadPoolExecutor(1, thread_name_prefix="view-compute")
        self._decoding = ThreadPoolExecutor(1, thread_name_prefix="view-decode")
        self._uploads = Uploads(UPLOADS_LIMIT_BYTES)
        self._waiting = 0
        studio = viewer.studio
        posts: dict[str, Answer] = {
            "/api/pictures": self.open_upload,
            "/api/examples/{number:int}": self.open_example,
            "/api/rows/{number:int}": self.open_row,
            "/api/factors": self.factors,
            "/api/neighbours": self.neighbours,
            "/api/view": partial(self.made, studio.view, "image/png"),
            "/api/picture": partial(self.made, studio.picture, "image/png"),
            "/api/panel": partial(self.made, studio.panel, "image/png"),
            "/api/mesh": partial(self.made, studio.mesh, "model/gltf-binary"),
            "/api/archive": partial(self.made, studio.archive, "application/zip"),
            "/api/settings": self.settings,
        }
        gets = {path: _page_file(*file) for path, file in PAGE_FILES.items()} | {"/api/about": self.about}
        routes = [Route(path, answer, methods=["POST"]) for path, answer in posts.items()]
        routes += [Route(path, answer, methods=["GET"]) for path, answer in gets.items()]
        handlers: dict[Any, Any] = {
            HTTPException: _no_such_address, Refused: _refusal, ClientDisconnect: _gone,
        }  # fmt: skip
        self.guarded = Guard(Starlette(routes=routes, exception_handlers=handlers), host)

    def close(self) -> None:
        """End the threads and let go of the gallery's source."""
        self._computing.shutdown(cancel_futures=True)
        self._decoding.shutdown(cancel_futures=True)
        if self.viewer.gallery is not None:
            self.viewer.gallery.close()

    async def about(self, request: Request) -> Response:
        """All that the page needs to draw itself."""
        examples = [
            {"name": example.name, "image": data_url(example.thumbnail(THUMBNAIL))}
            for example in self.viewer.examples
        ]
        table = None
        if (gallery := self.viewer.gallery) is not None:
            factors = [name for name in gallery.table.factors if name in self.viewer.studio.model.nets]
            table = {"rows": len(gallery.table), "factors": factors, "note": gallery.without_pictures}
        return JSONResponse(
            {
                "derender": __version__,
                "body_limit_bytes": BODY_LIMIT_BYTES,
                "pixel_limit": PIXEL_LIMIT,
                "examples": examples,
                "table": table,
                **self.viewer.studio.about(LARGEST_SIZE),
            }
        )

    async def open_upload(self, request: Request) -> Response:
        """Decompose the image in the body."""
        with self._uploads.one() as body:
            await self._receive(request, body, BODY_LIMIT_BYTES)
            photo = await self._work(self._decoding, _decoded, body)
        return await self._opened(photo)

    async def open_example(self, request: Request) -> Response:
        """Decompose one of the examples."""
        number = request.path_params["number"]
        if not 0 <= number < len(self.viewer.examples):
            raise Refused(404, f"there is no example {number}")
        return await self._opened(self.viewer.examples[number].picture)

    async def open_row(self, request: Request) -> Response:
        """Decompose the image of one row of the table."""
        gallery = self.viewer.gallery
        if gallery is None:
            raise Refused(404, "there is no table: start the viewer with --features FILE.parquet")
        number = request.path_params["number"]
        sizes = (LARGEST_SIZE, self.viewer.studio.model.image_size)
        photo, pixels = [await self._work(self._decoding, gallery.picture, number, size) for size in sizes]
        return await self._opened(photo.transpose(1, 2, 0), pixels)

    async def factors(self, request: Request) -> Response:
        """The maps of an image, by name, as images inside JSON."""
        question = await self._question(request, ViewRequest)
        maps = await self._work(self._computing, self.viewer.studio.maps, question)
        return JSONResponse({name: data_url(image) for name, image in maps.items()})

    async def settings(self, request: Request) -> Response:
        """Light and camera as JSON."""
        question = await self._question(request, ViewRequest)
        text = json.dumps(self.viewer.studio.settings(question), indent=1) + "\n"
        return Response(text, media_type="application/json")

    async def neighbours(self, request: Request) -> Response:
        """The rows nearest to an image by one factor, with their images where those are here."""
        question = await self._question(request, NeighbourRequest)
        found = await self._work(self._computing, self.viewer.studio.neighbours, question)
        gallery = self.viewer.gallery
        assert gallery is not None, "a studio with a table has a gallery"
        rows = []
        for row, distance in found:
            image = await self._work(self._decoding, _thumbnail, gallery, row)
            rows.append({**gallery.about(row), "distance": distance, "image": image})
        return JSONResponse({"factor": question.factor, "rows": rows})

    async def made(self, make: Callable[[ViewRequest], bytes], media_type: str, request: Request) -> Response:
        """Bytes that the studio makes for a question."""
        question = await self._question(request, ViewRequest)
        return Response(await self._work(self._computing, make, question), media_type=media_type)

    async def _opened(self, *images: Any) -> Response:
        return JSONResponse(await self._work(self._computing, self.viewer.studio.open, *images))

    async def _work(self, pool: ThreadPoolExecutor, function: Callable[..., Any], *arguments: Any) -> Any:
        """Have a thread do it, in turn; ``Refused`` (503) if too many wait or it takes too long."""
        if self._waiting >= WAITING_AT_MOST:
            raise Refused(503, "too many requests are waiting: try again in a moment")
        self._waiting += 1
        try:
            job = asyncio.get_running_loop().run_in_executor(pool, function, *arguments)
            return await asyncio.wait_for(job, self.work_seconds)
        except TimeoutError as late:
            raise Refused(503, "this took too long: try again, or choose a smaller size") from late
        finally:
            self._waiting -= 1

    async def _question(self, request: Request, kind: type[Q]) -> Q:
        body = Body()
        await self._receive(request, body, REQUEST_LIMIT_BYTES)
        return read_request(kind, bytes(body.content))

    async def _receive(self, request: Request, body: Body, limit: int) -> None:
        """Fill ``body``; ``Refused`` if it is too large (413), too slow (408) or had to make room (503)."""
        try:
            async with asyncio.timeout(self.body_seconds):
                async for part in request.stream():
                    body.take(part)
                    if body.received > limit:
                        body.drop()
                    self._uploads.make_room()
                    if body.received > limit + DRAINED_AT_MOST_BYTES:
                        break
        except TimeoutError as late:
            raise Refused(408, "the file came too slowly: try again") from late
        if body.received > limit:
            raise too_large() if limit == BODY_LIMIT_BYTES else Refused(413, "this request is too long")
        if body.dropped:
            raise Refused(503, "too many files are arriving at once: try again in a moment")
        body.whole = True


def _decoded(body: Body) -> Any:
    return photo_of(bytes(body.content))


def _thumbnail(gallery: Gallery, row: int) -> str | None:
    """A row's image inside JSON, or None where it cannot be shown."""
    try:
        return data_url(pictures(gallery.picture(row, THUMBNAIL)[None])[0])
    except Refused:
        return None


def _page_file(name: str, media_type: str) -> Answer:
    """An answer that is one of the page's own files, read now."""
    content = (files("derender.report.viewer") / "page" / name).read_bytes()

    async def answer(request: Request) -> Response:
        return Response(content, media_type=media_type)

    return answer


async def _no_such_address(request: Request, problem: HTTPException) -> Response:
    return JSONResponse({"error": problem.detail}, problem.status_code, headers=problem.headers)


async def _refusal(request: Request, refused: Refused) -> Response:
    return JSONResponse({"error": refused.message}, refused.status)


async def _gone(request: Request, problem: ClientDisconnect) -> Response:
    return Response(status_code=400)
