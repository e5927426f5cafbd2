"""What arrives by hand: bodies without end, lengths that lie, smuggled requests."""

import socket

import pytest
from tests.report.viewer.serving import serving

from derender.report.viewer.app import DRAINED_AT_MOST_BYTES, Application
from derender.report.viewer.questions import BODY_LIMIT_BYTES
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


@pytest.mark.parametrize(("length", "sent", "status"), [(1_000_000, 3, {408}), (1 << 60, 1000, {408, 413})])
def test_less_than_the_length_says_ends_in_time(model, length, sent, status):
    application = Application(Studio(model, "tiny", Shelf(2)), body_seconds=0.3)
    with serving(application) as url, connected(url) as connection:
        connection.sendall(head(url, more=f"Content-Length: {length}\r\n") + bytes(sent))
        assert int(answered(connection).split(b" ")[1]) in status


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
    assert result.count(b"HTTP/1.1 ") == 1 and b" 400 " in result
    assert b"Transfer-Encoding is refused" in result


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
