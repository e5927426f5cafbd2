"""A listening socket, and uvicorn on it, with bounds on time and on the number of connections.

The socket is opened before anything slow is loaded, so that a port in use is one error at once.
"""

import asyncio
import errno
import logging
import socket
from collections.abc import Iterator
from contextlib import contextmanager
from threading import Thread
from typing import TYPE_CHECKING, Any

import h11
import uvicorn
from uvicorn.protocols.http.h11_impl import H11Protocol

if TYPE_CHECKING:
    from derender.report.viewer.app import Application

HEAD_SECONDS = 10.0
TAKING_SECONDS = 30.0
KEEP_ALIVE_SECONDS = 30
CONNECTIONS_AT_MOST = 256
HEAD_LIMIT_BYTES = 16_384


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

    head_seconds = HEAD_SECONDS
    taking_seconds = TAKING_SECONDS
    _head_timer: asyncio.TimerHandle | None = None
    _taking_timer: asyncio.TimerHandle | None = None

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        super().connection_made(transport)
        self._watch_head()

    def data_received(self, data: bytes) -> None:
        super().data_received(data)
        self._watch_head()

    def connection_lost(self, exc: Exception | None) -> None:
        self._forget_head()
        self._forget_taking()
        super().connection_lost(exc)

    def on_response_complete(self) -> None:
        super().on_response_complete()
        if self.conn.their_state is h11.SEND_BODY:  # answered before its end, which may never come
            self.transport.close()

    def pause_writing(self) -> None:
        super().pause_writing()
        self._taking_timer = self.loop.call_later(self.taking_seconds, self.transport.abort)

    def resume_writing(self) -> None:
        self._forget_taking()
        super().resume_writing()

    def _forget_taking(self) -> None:
        if self._taking_timer is not None:
            self._taking_timer.cancel()
            self._taking_timer = None

    def _watch_head(self) -> None:
        if self.conn.their_state is not h11.IDLE:
            self._forget_head()
        elif self._head_timer is None:
            self._head_timer = self.loop.call_later(self.head_seconds, self._head_is_late)

    def _forget_head(self) -> None:
        if self._head_timer is not None:
            self._head_timer.cancel()
            self._head_timer = None

    def _head_is_late(self) -> None:
        self._head_timer = None
        if self.conn.their_state is h11.IDLE and not self.transport.is_closing():
            self.transport.close()


def server_for(application: "Application", **settings: Any) -> uvicorn.Server:
    """uvicorn with these bounds; keywords change its own settings."""
    logging.getLogger("uvicorn.error").setLevel(logging.ERROR)
    bounded: dict[str, Any] = {
        "http": BoundedProtocol,
        "ws": "none",
        "lifespan": "off",
        "log_config": None,
        "log_level": "error",
        "access_log": False,
        "server_header": False,
        "proxy_headers": False,
        "timeout_keep_alive": KEEP_ALIVE_SECONDS,
        "timeout_graceful_shutdown": 2,
        "limit_concurrency": CONNECTIONS_AT_MOST,
        "h11_max_incomplete_event_size": HEAD_LIMIT_BYTES,
    }
    return uvicorn.Server(uvicorn.Config(application.guarded, **{**bounded, **settings}))


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
