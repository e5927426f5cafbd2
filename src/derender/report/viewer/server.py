"""uvicorn on a listening socket, with bounds on time and on the number of connections."""

import asyncio
import logging
import socket
from collections.abc import Iterator
from contextlib import contextmanager
from threading import Thread
from typing import Any

import h11
import uvicorn
from uvicorn.protocols.http.h11_impl import H11Protocol

from derender.report.viewer.app import Application
from derender.report.viewer.listener import address_of, listen

HEAD_SECONDS = 10.0
TAKING_SECONDS = 30.0
KEEP_ALIVE_SECONDS = 30
CONNECTIONS_AT_MOST = 256
HEAD_LIMIT_BYTES = 16_384


class BoundedProtocol(H11Protocol):
    """uvicorn's protocol, which also ends who sends no head, or a body without end, or takes no answer."""

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


def server_for(application: Application, **settings: Any) -> uvicorn.Server:
    """uvicorn with our bounds; keywords change its own settings."""
    logging.getLogger("uvicorn.error").setLevel(logging.ERROR)
    chosen: dict[str, Any] = {
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
        **settings,
    }
    return uvicorn.Server(uvicorn.Config(application.guarded, **chosen))


def serve(application: Application, listener: socket.socket) -> None:
    """Answer until Ctrl-C or SIGTERM."""
    try:
        server_for(application).run(sockets=[listener])
    finally:
        listener.close()
        application.close()


@contextmanager
def serving(application: Application, host: str = "127.0.0.1", port: int = 0) -> Iterator[str]:
    """Answer in a thread of its own meanwhile; gives the address."""
    listener = listen(host, port)
    server = server_for(application)
    thread = Thread(target=server.run, kwargs={"sockets": [listener]}, name="view-server")
    thread.start()
    try:
        yield address_of(listener, host)
    finally:
        server.should_exit = True
        thread.join()
        listener.close()
        application.close()
