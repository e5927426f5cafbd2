"""What arrives by hand: bodies without end, lengths that lie, smuggled requests, answers nobody takes."""

import socket
import time
from collections.abc import Callable
from contextlib import ExitStack

import pytest

from derender.report.viewer import app
from derender.report.viewer.app import DRAINED_AT_MOST_BYTES, Application
from derender.report.viewer.questions import BODY_LIMIT_BYTES
from derender.report.viewer.server import BoundedProtocol, serving
from derender.report.viewer.studio import Shelf, Studio

CHUNKED = "Transfer-Encoding: chunked\r\n"


def connected(url: str) -> socket.socket:
    return socket.create_connection(place(url), timeout=10)


def place(url: str) -> tuple[str, int]:
    return "127.0.0.1", int(url.rsplit(":", 1)[1].strip("/"))


def head(url: str, path: str = "/api/pictures", more: str = "") -> bytes:
    host = f"127.0.0.1:{place(url)[1]}"
    return f"POST {path} HTTP/1.1\r\nHost: {host}\r\nX-Derender-Page: 1\r\n{more}\r\n".encode()


def answered(connection: socket.socket) -> bytes:
    """Everything until the server ends the connection or says no more for a second."""
    connection.settimeout(1)
    result = b""
    try:
        while part := connection.recv(65536):
            result += part
    except (TimeoutError, ConnectionResetError):
        pass
    return result


def wait_for(condition: Callable[[], bool]) -> None:
    """Return as soon as it holds; fails if it does not within ten seconds."""
    deadline = time.monotonic() + 10
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.005)


def test_a_chunked_body_without_end_is_cut_off(client):
    piece = bytes(1 << 20)
    chunk = f"{len(piece):x}\r\n".encode() + piece + b"\r\n"
    sent = 0
    with connected(client.url) as connection:
        connection.sendall(head(client.url, more=CHUNKED))
        with pytest.raises((ConnectionError, TimeoutError)):
            while sent < 1 << 30:
                connection.sendall(chunk)
                sent += len(piece)
        assert sent <= BODY_LIMIT_BYTES + DRAINED_AT_MOST_BYTES + (64 << 20)  # what sockets hold in between
    assert client.get("/api/about").status == 200


def test_an_address_that_reads_no_body_is_not_sent_one_for_ever(client):
    for method, path in (("GET", "/"), ("POST", "/nothing/here")):
        request = head(client.url, path, CHUNKED).replace(b"POST", method.encode(), 1)
        with connected(client.url) as connection:
            connection.sendall(request)
            with pytest.raises(ConnectionError):
                for _ in range(1 << 14):
                    connection.sendall(b"10000\r\n" + bytes(1 << 16) + b"\r\n")
    assert client.get("/api/about").status == 200


@pytest.mark.parametrize(("length", "sent", "status"), [(1_000_000, 3, {408}), (1 << 60, 1000, {408, 413})])
def test_less_than_the_length_says_ends_in_time(model, length, sent, status):
    application = Application(Studio(model, "tiny", Shelf(2)), body_seconds=0.3)
    with serving(application) as url, connected(url) as connection:
        connection.sendall(head(url, more=f"Content-Length: {length}\r\n") + bytes(sent))
        assert int(answered(connection).split(b" ")[1]) in status


@pytest.mark.parametrize("sent", [3, 900_000])
def test_uploads_that_stall_hold_up_no_other(model, sent):
    application = Application(Studio(model, "tiny", Shelf(2)), body_seconds=60)
    with serving(application) as url, ExitStack() as stalled:
        for _ in range(8):
            connection = stalled.enter_context(connected(url))
            connection.sendall(head(url, more="Content-Length: 1000000\r\n") + bytes(sent))
        wait_for(lambda: application._uploads.kept_bytes == 8 * sent)
        for size in (10, 2_000_000):
            with connected(url) as connection:
                connection.sendall(head(url, more=f"Content-Length: {size}\r\n") + bytes(size))
                assert b" 415 " in connection.recv(100)


def test_those_that_stall_make_room_for_the_others(model, monkeypatch):
    monkeypatch.setattr(app, "UPLOADS_LIMIT_BYTES", 1_000_000)
    application = Application(Studio(model, "tiny", Shelf(2)), body_seconds=60)
    with serving(application) as url, ExitStack() as stalled:
        begun = []
        for number in range(1, 9):  # each has to be slower than the one that comes last
            begun.append(stalled.enter_context(connected(url)))
            begun[-1].sendall(head(url, more="Content-Length: 130000\r\n") + bytes(120_000))
            wait_for(lambda sent=number * 120_000: application._uploads.kept_bytes == sent)
        with connected(url) as connection:
            connection.sendall(head(url, more="Content-Length: 500000\r\n") + bytes(500_000))
            assert b" 415 " in connection.recv(100)
        assert application._uploads.kept_bytes == 480_000
        answers = []
        for connection in begun:
            connection.sendall(bytes(10_000))
            answers.append(connection.recv(100).split(b" ")[1])
    assert answers == [b"503"] * 4 + [b"415"] * 4  # the first four were the slowest: as much, for longer


def test_large_uploads_at_once_are_all_answered(model):
    application = Application(Studio(model, "tiny", Shelf(2)))
    with serving(application) as url, ExitStack() as stalled:
        begun = [stalled.enter_context(connected(url)) for _ in range(12)]
        for connection in begun:
            connection.sendall(head(url, more="Content-Length: 1000000\r\n") + bytes(500_000))
        for connection in begun:
            connection.sendall(bytes(500_000))
        for connection in begun:
            assert b" 415 " in connection.recv(100)
        wait_for(lambda: application._uploads.kept_bytes == 0)


def test_what_follows_a_short_body_is_a_request_of_its_own_and_has_to_prove_itself(client):
    smuggled = b"POST /api/examples/0 HTTP/1.1\r\nHost: evil.example\r\nContent-Length: 0\r\n\r\n"
    with connected(client.url) as connection:
        connection.sendall(head(client.url, "/api/view", "Content-Length: 2\r\n") + b"{}" + smuggled)
        result = answered(connection)
    assert result.count(b"HTTP/1.1 ") == 2
    assert b" 422 " in result or b" 400 " in result
    assert b" 421 " in result


@pytest.mark.parametrize("more", [CHUNKED + "Content-Length: 4\r\n", "Content-Length: 4\r\n" + CHUNKED])
@pytest.mark.parametrize("method", ["GET", "POST"])
def test_a_length_beside_chunks_is_refused_and_nothing_behind_it_is_served(client, method, more):
    """A proxy that goes by one of them and a server that goes by the other see different requests."""
    with connected(client.url) as connection:
        one = head(client.url, "/api/view", more).replace(b"POST", method.encode())
        other = head(client.url, "/api/view", "Content-Length: 2\r\n") + b"{}"
        connection.sendall(one + b"0\r\n\r\n" + other)
        result = answered(connection)
    assert (
        result.count(b"HTTP/1.1 ") == 1 and b" 400 " in result and b"Transfer-Encoding is refused" in result
    )


@pytest.mark.parametrize(
    "more",
    [
        *("Content-Length: 2\r\nContent-Length: 30\r\n", "Content-Length: -1\r\n", "Content-Length: 2x\r\n"),
        "Content-Length: 5\r\nTransfer-Encoding: chunked\r\nTransfer-Encoding: identity\r\n",
        *("Host: evil.example\r\n", "X-Long: " + "a" * 100_000 + "\r\n", "Broken\r\n", "X: a\0b\r\n"),
    ],
)
def test_heads_that_say_two_things_are_refused(client, more):
    with connected(client.url) as connection:
        try:
            connection.sendall(head(client.url, "/api/view", more) + b"{}")
            result = answered(connection)
        except ConnectionError:
            result = b"HTTP/1.1 400 "
    assert result.split(b" ")[1] in (b"400", b"421", b"422"), result[:200]
    assert client.get("/api/about").status == 200


def test_broken_chunks_are_refused(client):
    for chunk in (b"zz\r\nab\r\n0\r\n\r\n", b"-1\r\nab\r\n", b"fffffffffffffffffffff\r\nab"):
        with connected(client.url) as connection:
            connection.sendall(head(client.url, "/api/view", CHUNKED) + chunk)
            result = answered(connection)
        assert b" 200 " not in result
    assert client.get("/api/about").status == 200


def test_answers_nobody_takes_end_the_connection(model, monkeypatch, client):
    monkeypatch.setattr(BoundedProtocol, "taking_seconds", 0.3)
    with serving(Application(Studio(model, "tiny", Shelf(2)))) as url:
        request = f"GET /view.js HTTP/1.1\r\nHost: 127.0.0.1:{place(url)[1]}\r\n\r\n".encode()
        with socket.socket() as connection:
            connection.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
            connection.settimeout(10)
            connection.connect(place(url))
            with pytest.raises(ConnectionError):
                for _ in range(100):  # far more than sockets hold
                    connection.sendall(request * 50)
                    time.sleep(0.05)
        assert type(client)(url).get("/api/about").status == 200
