"""A viewer that answers in a thread meanwhile."""

import socket
from collections.abc import Iterator
from contextlib import contextmanager
from threading import Thread

from derender.report.viewer.app import Application
from derender.report.viewer.server import address_of, listen, server_for


@contextmanager
def serving(application: Application) -> Iterator[str]:
    """At any free port; gives the address."""
    listener, server = listen("127.0.0.1", 0), server_for(application)
    thread = Thread(target=server.run, kwargs={"sockets": [listener]}, name="view-server")
    thread.start()
    assert listener.getsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY), "answers would wait for an ACK"
    try:
        yield address_of(listener, "127.0.0.1")
    finally:
        server.should_exit = True
        thread.join()
        listener.close()
        application.close()
