"""Only the page itself, opened by an address of this machine, gets answers."""

import pytest
from starlette.datastructures import Headers

from derender.report.viewer.server import Guard, allowed_host, is_loopback

HERE = ("127.0.0.1:8000", "localhost", "LOCALHOST:80", "[::1]:8000")
ELSEWHERE = ("evil.example", "127.0.0.1.evil.example:8000", "evil.example:127", "192.168.1.7:8000")
ELSEWHERE += ("localhost:80@evil.example", "[::1]evil", "[::1", "", ":8000")


@pytest.mark.parametrize(
    ("header", "bound", "allowed"),
    [
        *((header, "127.0.0.1", header in HERE) for header in HERE + ELSEWHERE),
        *(("192.168.1.7:8000", "0.0.0.0", True), ("[fe80::1]:8000", "::", True)),
        *(("evil.example:8000", "0.0.0.0", False), ("studio.local:8000", "studio.local", True)),
    ],
)
def test_host_names_that_are_answered(header, bound, allowed):
    assert allowed_host(header, bound) is allowed


def test_only_loopback_is_private():
    assert [is_loopback(host) for host in ("127.0.0.1", "127.9.9.9", "::1", "localhost")] == [True] * 4
    assert [is_loopback(host) for host in ("0.0.0.0", "::", "192.168.0.2", "box")] == [False] * 4


def refusal(method: str, path: str, **headers: str) -> int | None:
    async def nothing(scope, receive, send):
        raise AssertionError("not to be called")

    result = Guard(nothing, "127.0.0.1").refusal(method, path, Headers({"host": "localhost:1", **headers}))
    return None if result is None else result[0]


def test_which_requests_pass():
    own = {"x-derender-page": "1", "origin": "http://localhost:1"}
    assert refusal("GET", "/") is None
    assert refusal("GET", "/", **{"sec-fetch-site": "cross-site"}) is None  # a link to the page
    assert refusal("GET", "/api/about", **{"sec-fetch-site": "cross-site"}) == 403
    assert refusal("GET", "/api/about", **{"sec-fetch-site": "same-site"}) == 403
    assert refusal("POST", "/api/view", **own) is None
    assert refusal("POST", "/api/view", **{**own, "origin": "http://localhost:2"}) == 403
    assert refusal("POST", "/api/view", **{**own, "origin": "null"}) == 403
    assert refusal("POST", "/api/view", **{**own, "sec-fetch-site": "cross-site"}) == 403
    assert refusal("POST", "/api/view", origin="http://localhost:1") == 403  # as a form would send it
    assert refusal("GET", "/", host="rebound.example") == 421


def test_foreign_requests_reach_nothing(client):
    assert client.get("/", Host="rebound.example:80").status == 421
    reply = client.post("/api/examples/0", headers={"Origin": "http://evil.example"})
    assert (reply.status, reply.error) == (403, "requests from other pages are refused")
    assert client.post("/api/examples/0", headers={"X-Derender-Page": None}).status == 403
    assert client("OPTIONS", "/api/examples/0", headers={"Origin": "http://evil.example"}).status == 403
    assert client.post("/api/examples/0").status == 200


def test_every_answer_forbids_frames_scripts_and_storing(client):
    replies = [client.get("/"), client.get("/nowhere"), client.get("/", Host="rebound.example")]
    replies += [client.get("/api/about"), client.post("/api/pictures", b"no")]
    assert [reply.status for reply in replies] == [200, 404, 421, 200, 415]
    for reply in replies:
        policy = reply.headers["content-security-policy"]
        assert "default-src 'none'" in policy and "unsafe" not in policy and "http" not in policy
        assert reply.headers["x-content-type-options"] == "nosniff"
        assert reply.headers["cache-control"] == "no-store"
        assert "access-control-allow-origin" not in reply.headers
