"""A listening socket and uvicorn on it; requests that it accepts, and the headers of its answers.

The socket is opened before anything slow is loaded, so that a port in use is one error at once. A page on
another site can make a visitor's browser send requests here. Three checks stop it. The Host header must name
this machine and not a foreign name that was made to point here (DNS rebinding). A request that changes or
computes something must come from the page itself (Origin, Sec-Fetch-Site) and carry a header that no form can
send. No answer may be framed, embedded, sniffed or stored. Leaves out passwords: everyone who can reach the
address can use the page.
"""

import errno
import ipaddress
import logging
import os
import re
import socket
from dataclasses import dataclass
from typing import TYPE_CHECKING

import uvicorn
from starlette.datastructures import Headers, MutableHeaders
from starlette.responses import JSONResponse
from starlette.types import ASGIApp, Message, Receive, Scope, Send

if TYPE_CHECKING:
    from derender.report.viewer.app import Application

HOST = re.compile(r"(?:\[([^]]+)\]|([^:\[]+))(?::[0-9]*)?")  # name, name:port, [v6] or [v6]:port
OWN_HEADER = "x-derender-page"
SECURITY_HEADERS = {
    "content-security-policy": (
        "default-src 'none'; script-src 'self'; style-src 'self'; connect-src 'self'; img-src 'self' data: "
        "blob:; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
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
                MutableHeaders(scope=message).update(SECURITY_HEADERS)
            await send(message)

        answer = self.app
        if refusal := self.refusal(scope["method"], scope["path"], Headers(scope=scope)):
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
    if is_loopback(name) or is_loopback(bound):
        return is_loopback(name)
    return _address(name) is not None or name in {bound.lower(), socket.gethostname().lower()}


def is_loopback(host: str) -> bool:
    """Whether an address can be reached from this machine only."""
    address = _address(host)
    return host.lower() == "localhost" or (address is not None and address.is_loopback)


def _address(name: str) -> ipaddress.IPv4Address | ipaddress.IPv6Address | None:
    try:
        return ipaddress.ip_address(name)
    except ValueError:
        return None


def listen(host: str, port: int) -> socket.socket:
    """A listening socket; port 0 takes any free one.

    Raises:
        ValueError: the port is in use or not allowed, or the address is not one of this machine.
    """
    if not 0 <= port <= 65535:
        raise ValueError(f"port must lie in 0..65535, got {port}: 0 takes any free one")
    try:
        family, *_, address = socket.getaddrinfo(host, port, flags=socket.AI_PASSIVE)[0]
        both = family == socket.AF_INET6 and socket.has_dualstack_ipv6()
        listener = socket.create_server(address, family=family, backlog=128, dualstack_ipv6=both)
        listener.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)  # else a body waits for an ACK, 40 ms
        return listener
    except socket.gaierror as problem:
        raise ValueError(f"host {host} is no address of this machine: use 127.0.0.1") from problem
    except OSError as problem:
        reasons = {
            errno.EADDRINUSE: f"port {port} of {host} is in use: choose another port, or 0 for any free one",
            errno.EACCES: f"port {port} needs more rights: choose a port above 1023, or 0",
        }
        other = f"cannot listen on {host} port {port} ({os.strerror(problem.errno or 0)}): use host 127.0.0.1"
        raise ValueError(reasons.get(problem.errno or 0, other)) from problem


def address_of(listener: socket.socket, host: str) -> str:
    """The address to open in a browser."""
    port = listener.getsockname()[1]
    shown = {"0.0.0.0": "127.0.0.1", "::": "[::1]", "": "127.0.0.1"}.get(host, host)
    return f"http://{f'[{shown}]' if ':' in shown and not shown.startswith('[') else shown}:{port}/"


def server_for(application: "Application") -> uvicorn.Server:
    """uvicorn with these bounds."""
    config = uvicorn.Config(
        application.guarded, http="h11", ws="none", lifespan="off", log_config=None, log_level="error",
        server_header=False, proxy_headers=False, timeout_keep_alive=30, timeout_graceful_shutdown=1,
        limit_concurrency=256, h11_max_incomplete_event_size=16_384,
    )  # fmt: skip
    return uvicorn.Server(config)


def serve(application: "Application", listener: socket.socket) -> None:
    """Answer until Ctrl-C or SIGTERM; work that has begun then is not waited for."""
    server = server_for(application)
    logging.getLogger("uvicorn.error").addFilter(lambda _: not server.should_exit)  # ended answers are none
    try:
        server.run(sockets=[listener])
    finally:
        listener.close()
        application.close(wait=False)
