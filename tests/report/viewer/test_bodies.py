"""Uploads together keep no more than their bound, whatever comes; the slowest makes room, no whole one."""

from contextlib import ExitStack

import numpy as np
import pytest

from derender.report.viewer.app import Body, Uploads


def begun(uploads: Uploads, stack: ExitStack, content: bytes, seconds_ago: float) -> Body:
    body = stack.enter_context(uploads.one())
    body.began_s -= seconds_ago
    body.take(content)
    uploads.make_room()
    return body


def test_a_body_keeps_what_comes_and_nothing_once_dropped():
    body = Body()
    body.take(b"one ")
    body.take(b"two")
    assert (bytes(body.content), body.received, body.dropped) == (b"one two", 7, False)
    body.drop()
    body.take(b"three")
    assert (bytes(body.content), body.received, body.dropped) == (b"", 12, True)


def test_the_slowest_makes_room_and_no_more_than_needed():
    uploads = Uploads(100)
    with ExitStack() as stack:
        stalled = begun(uploads, stack, bytes(30), 20)
        trickling = begun(uploads, stack, bytes(40), 25)
        quick = begun(uploads, stack, bytes(30), 1)
        assert uploads.kept_bytes == 100
        newest = begun(uploads, stack, bytes(10), 0.5)
        assert [body.dropped for body in (stalled, trickling, quick, newest)] == [True, False, False, False]
        assert uploads.kept_bytes == 80
        quick.take(bytes(50))
        uploads.make_room()
        assert [body.dropped for body in (trickling, quick, newest)] == [True, False, False]
    assert uploads.kept_bytes == 0


def test_a_whole_one_stays_while_it_waits_and_the_newcomer_is_let_go_of():
    uploads = Uploads(100)
    with ExitStack() as stack:
        whole = begun(uploads, stack, bytes(90), 1000)
        whole.whole = True
        newest = begun(uploads, stack, bytes(20), 0.01)
        assert (whole.dropped, newest.dropped) == (False, True)
        assert len(whole.content) == 90


def test_who_goes_away_gives_the_room_back():
    uploads = Uploads(100)
    with pytest.raises(ConnectionError), uploads.one() as body:
        body.take(bytes(100))
        raise ConnectionError
    with ExitStack() as stack:
        assert not begun(uploads, stack, bytes(100), 0).dropped


def test_the_bound_holds_whatever_comes():
    draw = np.random.default_rng(0)
    uploads, open_ones = Uploads(1_000), []
    most = 0
    for _ in range(3_000):
        with ExitStack() as stack:
            if len(open_ones) < 20:
                open_ones.append((begun(uploads, stack, b"", draw.uniform(0, 30)), stack.pop_all()))
        body, closing = open_ones[draw.integers(len(open_ones))]
        before = [other for other, _ in open_ones if other.whole]
        if not body.whole:
            body.take(bytes(draw.integers(200)))
            uploads.make_room()
            body.whole = not body.dropped and draw.random() < 0.1
        assert not any(other.dropped for other in before)
        most = max(most, uploads.kept_bytes)
        assert uploads.kept_bytes == sum(len(other.content) for other, _ in open_ones)
        if body.dropped or (body.whole and draw.random() < 0.3):
            closing.close()
            open_ones = [pair for pair in open_ones if pair[0] is not body]
    assert 900 < most <= 1_000
