"""A listening socket and uvicorn on it; requests that it accepts, their bodies, the headers of its answers.

The socket is opened before anything slow is loaded, so that a port in use is one error at once. Time, size
and the number of connections are bounded. A page on another site can make a visitor's browser send requests
here. Three checks stop it. The Host header must name this machine and not a foreign name that was made to
point here (DNS rebinding). A request that changes or computes something must come from the page itself
(Origin, Sec-Fetch-Site) and carry a header that no form can send. No answer may be framed, embedded, sniffed
or stored. Leaves out passwords: everyone who can reach the address can use the page.
"""

import asyncio
import errno
import ipaddress
import logging
import re
import socket
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from threading import Thread
from typing import TYPE_CHECKING

import h11
import uvicorn
from starlette.datastructures import Headers, MutableHeaders
from starlette.responses import JSONResponse
from starlette.types import ASGIApp, Message, Receive, Scope, Send
from uvicorn.protocols.http.h11_impl import H11Protocol

if TYPE_CHECKING:
    from derender.report.viewer.app import Application

HOST = re.compile(r"(?:\[([^]]+)\]|([^:\[]+))(?::[0-9]*)?")
"""``name``, ``name:port``, ``[v6]`` or ``[v6]:port``."""
OWN_HEADER = "x-derender-page"
SECURITY_HEADERS = {
    "content-security-policy": (
        "default-src 'none'; script-src 'self'; style-src 'self'; connect-src 'self'; "
        "img-src 'self' data: blob:; "
        "base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
    ),
    "cross-origin-opener-policy": "same-origin",
    "cross-origin-resource-policy": "same-origin",
    "x-content-type-options": "nosniff",
    "x-frame-options": "DENY",
    "referrer-policy": "no-referrer",
    "cache-control": "no-store",
}


@dataclass(frozen=True)
class Guard:
    """An application that answers only requests of its own page, at the address its server listens on."""

    app: ASGIApp
    host: str

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            return

        async def send_guarded(message: Message) -> None:
            if message["type"] == "http.response.start":
                headers = MutableHeaders(scope=message)
                for name, value in SECURITY_HEADERS.items():
                    headers[name] = value
            await send(message)

        refusal = self.refusal(scope["method"], scope["path"], Headers(scope=scope))
        if refusal is None:
            await self.app(scope, receive, send_guarded)
            return
        status, reason = refusal
        answer = JSONResponse({"error": reason}, status, headers={"connection": "close"})
        await answer(scope, receive, send_guarded)

    def refusal(self, method: str, path: str, headers: Headers) -> tuple[int, str] | None:
        """Status and reason why a request is not let through, or None."""
        host = headers.get("host", "")
        if len(headers.getlist("host")) != 1 or not allowed_host(host, self.host):
            return 421, "this server is not known by that name: open it by the address it printed"
        site = headers.get("sec-fetch-site", "same-origin")
        reading = method in ("GET", "HEAD")
        if site not in ("same-origin", "none") and not (reading and path == "/"):
            return 403, "requests from other pages are refused"
        if "content-length" in headers and "transfer-encoding" in headers:
            return 400, "a request with Content-Length and Transfer-Encoding is refused"
        if reading:
            return None
        origin = headers.get("origin")
        if origin is not None and origin != f"http://{host}":
            return 403, "requests from other pages are refused"
        if OWN_HEADER not in headers:
            return 403, "this request does not come from the page"
        return None


def allowed_host(header: str, bound: str) -> bool:
    """Whether a Host header names this machine.

    A server on a loopback address answers to loopback names only. Elsewhere it also answers to its own and
    the machine's name, and to any numeric address (no foreign name server can hand one out).
    """
    if (match := HOST.fullmatch(header)) is None:
        return False
    name = (match[1] or match[2]).lower().rstrip(".")
    if name == "localhost":
        return True
    address = _address(name)
    if is_loopback(bound):
        return address is not None and address.is_loopback
    return address is not None or name in {bound.lower(), socket.gethostname().lower()}


def is_loopback(host: str) -> bool:
    """Whether an address can be reached from this machine only."""
    address = _address(host)
    return host.lower() == "localhost" or (address is not None and address.is_loopback)


def _address(name: str) -> ipaddress.IPv4Address | ipaddress.IPv6Address | None:
    try:
        return ipaddress.ip_address(name)
    except ValueError:
        return None


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
            later_s = time.monotonic() + 1e-6
            arriving = (body for body in self._bodies if body.content and not body.whole)
            min(arriving, key=lambda body: body.received / (later_s - body.began_s)).drop()


def listen(host: str, port: int) -> socket.socket:
    """A listening socket; port 0 takes any free one.

    Raises:
        ValueError: the port is in use or not allowed, or the address is not one of this machine.
    """
    if not 0 <= port <= 65535:
        raise ValueError(f"port must lie in 0..65535, got {port}: 0 takes any free one")
    try:
        family, kind, protocol, _, address = socket.getaddrinfo(
            host, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE
        )[0]
    except OSError as problem:
        raise ValueError(f"host {host} is no address of this machine: use 127.0.0.1") from problem
    listener = socket.socket(family, kind, protocol)
    try:
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        listener.bind(address)
        listener.listen(128)
    except OSError as problem:
        listener.close()
        reasons = {
            errno.EADDRINUSE: f"port {port} of {host} is in use: choose another port, or 0 for any free one",
            errno.EACCES: f"port {port} needs more rights: choose a port above 1023, or 0",
        }
        other = f"cannot listen on {host} port {port} ({problem.strerror}): use host 127.0.0.1"
        raise ValueError(reasons.get(problem.errno or 0, other)) from problem
    listener.setblocking(False)
    return listener


def address_of(listener: socket.socket, host: str) -> str:
    """The address to open in a browser."""
    port = listener.getsockname()[1]
    shown = {"0.0.0.0": "127.0.0.1", "::": "[::1]", "": "127.0.0.1"}.get(host, host)
    return f"http://{f'[{shown}]' if ':' in shown and not shown.startswith('[') else shown}:{port}/"


class BoundedProtocol(H11Protocol):
    """uvicorn's protocol, which also ends connections without head, with endless bodies, or that stall."""

    head_seconds = 10.0
    taking_seconds = 30.0
    _head_timer: asyncio.TimerHandle | None = None
    _taking_timer: asyncio.TimerHandle | None = None

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        super().connection_made(transport)
        self._watch_head()

    def data_received(self, data: bytes) -> None:
        super().data_received(data)
        self._watch_head()

    def connection_lost(self, exc: Exception | None) -> None:
        self._head_timer, self._taking_timer = _ended(self._head_timer), _ended(self._taking_timer)
        super().connection_lost(exc)

    def on_response_complete(self) -> None:
        super().on_response_complete()
        if self.conn.their_state is h11.SEND_BODY:  # answered before its end, which may never come
            self.transport.close()

    def pause_writing(self) -> None:
        super().pause_writing()
        self._taking_timer = self.loop.call_later(self.taking_seconds, self.transport.abort)

    def resume_writing(self) -> None:
        self._taking_timer = _ended(self._taking_timer)
        super().resume_writing()

    def _watch_head(self) -> None:
        if self.conn.their_state is not h11.IDLE:
            self._head_timer = _ended(self._head_timer)
        elif self._head_timer is None:
            self._head_timer = self.loop.call_later(self.head_seconds, self.transport.close)


def _ended(timer: asyncio.TimerHandle | None) -> None:
    if timer is not None:
        timer.cancel()


def server_for(application: "Application") -> uvicorn.Server:
    """uvicorn with these bounds."""
    logging.getLogger("uvicorn.error").setLevel(logging.ERROR)
    config = uvicorn.Config(
        application.guarded,
        http=BoundedProtocol,
        ws="none",
        lifespan="off",
        log_config=None,
        log_level="error",
        access_log=False,
        server_header=False,
        proxy_headers=False,
        timeout_keep_alive=30,
        timeout_graceful_shutdown=2,
        limit_concurrency=256,
        h11_max_incomplete_event_size=16_384,
    )
    return uvicorn.Server(config)


def serve(application: "Application", listener: socket.socket) -> None:
    """Answer until Ctrl-C or SIGTERM."""
    try:
        server_for(application).run(sockets=[listener])
    finally:
        listener.close()
        application.close()


@contextmanager
def serving(application: "Application") -> Iterator[str]:
    """Answer in a thread meanwhile, at any free port; gives the address."""
    listener = listen("127.0.0.1", 0)
    server = server_for(application)
    thread = Thread(target=server.run, kwargs={"sockets": [listener]}, name="view-server")
    thread.start()
    try:
        yield address_of(listener, "127.0.0.1")
    finally:
        server.should_exit = True
        thread.join()
        listener.close()
        application.close()
