"""Requests that the server accepts, their bodies as they arrive, and the headers of its answers.

A page on another site can make a visitor's browser send requests here. Three checks stop it. The Host header
must name this machine and not a foreign name that was made to point here (DNS rebinding). A request that
changes or computes something must come from the page itself (Origin, Sec-Fetch-Site) and carry a header that
no form can send. No answer may be framed, embedded, sniffed or stored. Leaves out passwords: everyone who can
reach the address can use the page.
"""

import ipaddress
import json
import socket
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field

from starlette.datastructures import Headers, MutableHeaders
from starlette.types import ASGIApp, Message, Receive, Scope, Send

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
        body = json.dumps({"error": reason}).encode()
        kind = [(b"content-type", b"application/json"), (b"connection", b"close")]
        await send_guarded({"type": "http.response.start", "status": status, "headers": kind})
        await send_guarded({"type": "http.response.body", "body": body})

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
    name = _name_of(header)
    if name is None:
        return False
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


def _name_of(header: str) -> str | None:
    """The name in ``name``, ``name:port``, ``[v6]`` or ``[v6]:port``; None for anything else."""
    if header.startswith("["):
        name, bracket, port = header[1:].partition("]")
        port = port.removeprefix(":") if port.startswith(":") else ("x" if port else "")
        name = name if bracket else ""
    else:
        name, _, port = header.partition(":")
    if not name or (port and not (port.isascii() and port.isdigit())):
        return None
    return name.lower().rstrip(".")


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
