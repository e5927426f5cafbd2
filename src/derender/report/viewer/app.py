"""The addresses of the page and their answers, within bounds of size, time and number.

Nothing in a request can name a file: the page's own files are read once at the start, images are known by
names that the shelf made up, examples and rows by number. Bodies are read up to a limit, and all uploads
together keep no more than another. Decoding and computing have one thread each: a heavy upload does not hold
up the sliders of others.
"""

import asyncio
import json
from collections.abc import Awaitable, Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
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
from derender.model import Derenderer
from derender.report.colours import pictures
from derender.report.opening import held_out_errors, readable
from derender.report.viewer.guard import Body, Guard, Uploads
from derender.report.viewer.neighbours import Example, Gallery, named_examples, rendered_examples
from derender.report.viewer.questions import (
    BODY_LIMIT_BYTES,
    LARGEST_SIZE,
    PIXEL_LIMIT,
    CropRequest,
    FilmRequest,
    NeighbourRequest,
    Q,
    Refused,
    ViewRequest,
    photo_of,
    read_request,
    too_large,
)
from derender.report.viewer.shelf import KEPT, Shelf
from derender.report.viewer.studio import Studio, data_url

BODY_SECONDS = 30.0
WORK_SECONDS, LONG_WORK = 30.0, 6
"""An answer has to be there; films and fits may take so many times as long."""

REQUEST_LIMIT_BYTES = 10_000
UPLOADS_LIMIT_BYTES = 10 * BODY_LIMIT_BYTES
"""Of all uploads together that arrive or wait to be decoded."""

WAITING_AT_MOST = 200
DRAINED_AT_MOST_BYTES = 3 * BODY_LIMIT_BYTES
"""So much of a body that is too large is still read and dropped, so that browsers see the answer."""

THUMBNAIL = 96
MEDIA_TYPES = {
    b"\x89PNG": "image/png", b"\xff\xd8": "image/jpeg", b"GIF8": "image/gif", b"glTF": "model/gltf-binary",
    b"PK": "application/zip",
}  # fmt: skip
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
        model, source: trained, and where it was loaded from.
        images: image files to begin with; without any, rendered ones for the bundled models.
        table: features made by this model, for nearest neighbours.
        data, dataset: place of the table's images, if not as the table records it, and its layout.
        keep: opened images held in memory.
        fit_steps, frame: as ``Studio`` takes them.
    """
    if fit_steps:
        model.features.required_fitting(source)
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
    examples = named_examples(read) if images else rendered_examples(source)
    return Viewer(studio, examples, gallery), notes


Answer = Callable[[Request], Awaitable[Response]]


class Application:
    """The answers, and the threads that work them out; an ASGI application as ``guarded``.

    A body has to arrive within ``body_seconds``, an answer within ``work_seconds``, waiting included.
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
            "/api/crop": self.crop,
            "/api/film": partial(self.made, studio.film, FilmRequest, patience=LONG_WORK),
            "/api/settings": self.settings,
        }
        makers = ("view", "before", "preview", "picture", "panel", "mesh", "archive")
        posts |= {f"/api/{name}": partial(self.made, getattr(studio, name), ViewRequest) for name in makers}
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
                **self.viewer.studio.about(),
            }
        )

    async def open_upload(self, request: Request) -> Response:
        """Decompose the image in the body."""
        with self._uploads.one() as body:
            await self._receive(request, body, BODY_LIMIT_BYTES)
            photo = await self._work(self._decoding, lambda: photo_of(bytes(body.content)))
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

    async def made(
        self, make: Callable[[Any], bytes], kind: type[Q], request: Request, *, patience: int = 1
    ) -> Response:
        """Bytes that the studio makes for a question."""
        question = await self._question(request, kind)
        content = await self._work(self._computing, make, question, patience=patience)
        known = (kind for start, kind in MEDIA_TYPES.items() if content.startswith(start))
        return Response(content, media_type=next(known, "video/mp4"))

    async def crop(self, request: Request) -> Response:
        """Decompose an opened image again."""
        question = await self._question(request, CropRequest)
        again = self.viewer.studio.again
        return JSONResponse(await self._work(self._computing, again, question, patience=LONG_WORK))

    async def _opened(self, *images: Any) -> Response:
        return JSONResponse(await self._work(self._computing, self.viewer.studio.open, *images))

    async def _work(
        self, pool: ThreadPoolExecutor, function: Callable[..., Any], *arguments: Any, patience: int = 1
    ) -> Any:
        """Have a thread do it, in turn; ``Refused`` (503) if too many wait or it takes too long."""
        if self._waiting >= WAITING_AT_MOST:
            raise Refused(503, "too many requests are waiting: try again in a moment")
        self._waiting += 1
        try:
            job = asyncio.get_running_loop().run_in_executor(pool, function, *arguments)
            return await asyncio.wait_for(job, patience * self.work_seconds)
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
