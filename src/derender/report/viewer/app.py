"""The addresses of the page and their answers, within bounds of size, time and number.

Nothing in a request can name a file: the page's own files are read once at the start, images are known by
names that the shelf made up, examples and rows by number. Bodies are read up to a limit. Decoding and
computing have one thread each: a heavy upload does not hold up the sliders of others.
"""

import asyncio
from collections.abc import Awaitable, Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
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
from derender.photo import editing_steps
from derender.report.opening import held_out_errors, readable
from derender.report.page import IMAGE_TYPES
from derender.report.viewer import questions
from derender.report.viewer.images import KEPT, Example, Gallery, Shelf, rendered_examples
from derender.report.viewer.questions import BODY_LIMIT_BYTES, Question, Refused, ViewRequest, too_large
from derender.report.viewer.server import Guard
from derender.report.viewer.studio import Studio

LONG_WORK = 6  # opening, which fits, and films may take so many times as long as other answers

REQUEST_LIMIT_BYTES = 10_000

DRAINED_AT_MOST_BYTES = 3 * BODY_LIMIT_BYTES  # of a body that is too large, so that browsers see the answer

FILE_TYPES = {b"glTF": "model/gltf-binary", b"PK": "application/zip", b"{": "application/json"}
MEDIA_TYPES = IMAGE_TYPES | FILE_TYPES
PAGE_FILES = {"index.html": "html", "view.css": "css", "view.js": "javascript", "surface.js": "javascript"}


def open_viewer(
    model: Derenderer, source: str, images: Sequence[Path] = (), *, table: FeatureTable | None = None,
    data: str | None = None, dataset: str = "auto", keep: int = KEPT, fit_steps: int | None = None,
    frame: str | None = None,
) -> tuple[Studio, list[str]]:  # fmt: skip
    """A model with images to begin with and rows to search, and notes on what is missing.

    Args:
        model, source: trained, and where it was loaded from.
        images: image files to begin with; without any, rendered ones for the bundled models.
        table: features made by this model, for nearest neighbours.
        data, dataset: place of the table's images, if not as the table records it, and its layout.
        keep: opened images held in memory.
        fit_steps, frame: as ``Studio`` takes them; by default the steps of edits.
    """
    if fit_steps:
        model.features.required_fitting(source)
    if table is not None and not set(table.factors) & set(model.nets):
        raise ValueError(f"the table has none of the factors of {source}: make it anew by derender embed")
    gallery = None if table is None else Gallery(table, data, dataset)
    read, problems = readable(images, read_photo)
    notes = [f"left out {path}: {reason}" for path, reason in problems.items()]
    if gallery is not None and gallery.without_pictures:
        notes.append(f"neighbours are shown without images: {gallery.without_pictures}")
    named = [Example(path.name, pixels) for path, pixels in read.items()]
    studio = Studio(
        model, Path(source).name, Shelf(keep), named if images else rendered_examples(source), gallery,
        held_out_errors(source), editing_steps(model, fit_steps), frame,
    )  # fmt: skip
    return studio, notes


class Application:
    """The answers, and the threads that work them out; an ASGI application as ``guarded``.

    A body has to arrive within ``body_seconds``, an answer within ``work_seconds``, waiting included.
    """

    def __init__(
        self, studio: Studio, host: str = "127.0.0.1", body_seconds: float = 30.0, work_seconds: float = 30.0
    ):
        self.studio = studio
        self.body_seconds, self.work_seconds = body_seconds, work_seconds
        self._computing = ThreadPoolExecutor(1, thread_name_prefix="view-compute")
        self._decoding = ThreadPoolExecutor(1, thread_name_prefix="view-decode")
        posts: dict[str, Callable[[Request], Awaitable[Response]]] = {
            "/api/pictures": self.open_upload,
            "/api/examples/{number:int}": self.open_example,
            "/api/rows/{number:int}": self.open_row,
            "/api/neighbours": self.neighbours,
            "/api/crop": partial(self.made, studio.again, questions.CropRequest, patience=LONG_WORK),
            "/api/film": partial(self.made, studio.film, questions.FilmRequest, patience=LONG_WORK),
        }
        makers = ("view", "before", "preview", "picture", "panel", "mesh", "archive", "factors", "settings")
        posts |= {f"/api/{name}": partial(self.made, getattr(studio, name), ViewRequest) for name in makers}
        routes = [Route(path, answer, methods=["POST"]) for path, answer in posts.items()]
        routes.append(Route("/api/about", self.about, methods=["GET"]))
        for name, kind in PAGE_FILES.items():
            content = (files("derender.report.viewer") / "page" / name).read_bytes()
            page = Response(content, media_type=f"text/{kind}")
            routes.append(Route("/" if kind == "html" else f"/{name}", page, methods=["GET"]))
        handled = (HTTPException, Refused, ValueError, ClientDisconnect)
        handlers: dict[Any, Any] = dict.fromkeys(handled, _problem)
        self.guarded = Guard(Starlette(routes=routes, exception_handlers=handlers), host)

    def close(self, *, wait: bool = True) -> None:
        """End the threads, by default after the work they have begun, and let go of the gallery's source."""
        self._computing.shutdown(wait, cancel_futures=True)
        self._decoding.shutdown(wait, cancel_futures=True)
        if self.studio.gallery is not None:
            self.studio.gallery.close()

    async def about(self, request: Request) -> Response:
        """All that the page needs to draw itself."""
        limits = {"body_limit_bytes": BODY_LIMIT_BYTES, "pixel_limit": questions.PIXEL_LIMIT}
        return JSONResponse({"derender": __version__, **limits, **self.studio.about()})

    async def open_upload(self, request: Request) -> Response:
        """Decompose the image in the body."""
        content = await self._receive(request, BODY_LIMIT_BYTES)
        return await self._opened(await self._work(self._decoding, questions.photo_of, content))

    async def open_example(self, request: Request) -> Response:
        """Decompose one of the examples."""
        number = request.path_params["number"]
        if not 0 <= number < len(self.studio.examples):
            raise Refused(404, f"there is no example {number}")
        return await self._opened(self.studio.examples[number].picture)

    async def open_row(self, request: Request) -> Response:
        """Decompose the image of one row of the table."""
        gallery, number = self.studio.searched(), request.path_params["number"]
        sizes = (questions.LARGEST_SIZE, self.studio.model.image_size)
        photo, pixels = [await self._work(self._decoding, gallery.picture, number, size) for size in sizes]
        return await self._opened(photo.transpose(1, 2, 0), pixels)

    async def neighbours(self, request: Request) -> Response:
        """The rows nearest to an image by one factor, with their images where those are here."""
        question = await self._question(request, questions.NeighbourRequest)
        rows, gallery = [], self.studio.searched()
        for row, distance in await self._work(self._computing, self.studio.neighbours, question):
            shown = await self._work(self._decoding, gallery.shown, row)
            rows.append({**shown, "distance": distance})
        return JSONResponse({"factor": question.factor, "rows": rows})

    async def made(
        self, make: Callable[[Any], Any], kind: type[Question], request: Request, *, patience: int = 1
    ) -> Response:
        """What the studio makes for a question: the bytes of a file, or values as JSON."""
        question = await self._question(request, kind)
        content = await self._work(self._computing, make, question, patience=patience)
        if not isinstance(content, bytes):
            return JSONResponse(content)
        known = (kind for start, kind in MEDIA_TYPES.items() if content.startswith(start))
        return Response(content, media_type=next(known, "video/mp4"))

    async def _opened(self, *images: Any) -> Response:
        return JSONResponse(await self._work(self._computing, self.studio.open, *images, patience=LONG_WORK))

    async def _work(
        self, pool: ThreadPoolExecutor, function: Callable[..., Any], *arguments: Any, patience: int = 1
    ) -> Any:
        """Have a thread do it, in turn; ``Refused`` (503) if it takes too long."""
        try:
            job = asyncio.get_running_loop().run_in_executor(pool, function, *arguments)
            return await asyncio.wait_for(job, patience * self.work_seconds)
        except TimeoutError as late:
            raise Refused(503, "this took too long: try again, or with fewer --fit-steps") from late

    async def _question(self, request: Request, kind: type[Question]) -> Question:
        return questions.read_request(kind, await self._receive(request, REQUEST_LIMIT_BYTES))

    async def _receive(self, request: Request, limit: int) -> bytes:
        """The body of a request; ``Refused`` if it is too large (413) or too slow (408)."""
        content, received = bytearray(), 0
        try:
            async with asyncio.timeout(self.body_seconds):
                async for part in request.stream():
                    received += len(part)
                    if received <= limit:
                        content += part
                    elif received > limit + DRAINED_AT_MOST_BYTES:
                        break
        except TimeoutError as late:
            raise Refused(408, "the file came too slowly: try again") from late
        if received > limit:
            raise too_large() if limit == BODY_LIMIT_BYTES else Refused(413, "this request is too long")
        return bytes(content)


async def _problem(request: Request, problem: Exception) -> Response:
    if isinstance(problem, ValueError):  # of a question that makes no sense for this model or image
        problem = Refused(422, str(problem))
    if isinstance(problem, Refused):
        ended = {"connection": "close"} if problem.status in (408, 413) else None  # its rest may never come
        return JSONResponse({"error": problem.message}, problem.status, headers=ended)
    if isinstance(problem, HTTPException):  # no such address
        return JSONResponse({"error": problem.detail}, problem.status_code, headers=problem.headers)
    return Response(status_code=400)
