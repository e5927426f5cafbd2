"""The viewer's memory is bounded: opened images, of which the longest unused leaves, and all uploads."""

import re
from contextlib import ExitStack
from dataclasses import replace

import numpy as np
import pytest
import torch

from derender.photo import Frame
from derender.report.viewer.images import Shelf, ShownImage
from derender.report.viewer.questions import Refused
from derender.report.viewer.server import Body, Uploads
from derender.scene import Scene


@pytest.fixture
def image() -> ShownImage:
    scene = Scene(torch.ones(1, 4, 4), torch.zeros(1, 3, 4, 4), torch.zeros(1, 4), torch.zeros(1, 6))
    small = np.zeros((3, 4, 4), np.uint8)
    return ShownImage(np.zeros((9, 9, 3), np.uint8), (), Frame.centred(9, 9), "none", small, scene, {})


def test_the_longest_unused_image_leaves_first(image):
    shelf = Shelf(3)
    first, second, third = (shelf.put(image) for _ in range(3))
    shelf.get(first)
    fourth = shelf.put(image)
    assert len(shelf) == 3 and all(shelf.get(name) is image for name in (first, third, fourth))
    with pytest.raises(Refused, match="no longer stored") as refused:
        shelf.get(second)
    assert refused.value.status == 410
    with pytest.raises(ValueError, match="room for 2"):
        Shelf(1)


def test_photographs_take_no_more_memory_than_allowed(image):
    shelf = Shelf(10, limit_bytes=3 * image.photo.nbytes)
    for _ in range(5):
        shelf.put(replace(image, photo=image.photo.copy()))
    assert len(shelf) == 3
    crops = Shelf(10, limit_bytes=image.photo.nbytes)
    for _ in range(5):
        crops.put(image)  # crops of one photograph
    assert len(crops) == 5


def test_names_cannot_be_guessed(image):
    names = {Shelf(200).put(image) for _ in range(200)}
    assert len(names) == 200 and all(re.fullmatch(r"[A-Za-z0-9_-]{22}", name) for name in names)


def begun(uploads: Uploads, stack: ExitStack, content: bytes, seconds_ago: float) -> Body:
    body = stack.enter_context(uploads.one())
    body.began_s -= seconds_ago
    body.take(content)
    uploads.make_room()
    return body


def test_the_slowest_makes_room_and_no_more_than_needed():
    uploads = Uploads(100)
    with ExitStack() as stack:
        stalled = begun(uploads, stack, bytes(30), 20)
        trickling = begun(uploads, stack, bytes(40), 25)
        quick = begun(uploads, stack, bytes(30), 1)
        assert uploads.kept_bytes == 100
        newest = begun(uploads, stack, bytes(10), 0.5)
        assert [body.dropped for body in (stalled, trickling, quick, newest)] == [True, False, False, False]
        stalled.take(b"three")
        assert (bytes(stalled.content), stalled.received, uploads.kept_bytes) == (b"", 35, 80)
        quick.take(bytes(50))
        uploads.make_room()
        assert [body.dropped for body in (trickling, quick, newest)] == [True, False, False]
    assert uploads.kept_bytes == 0


def test_a_whole_upload_stays_while_it_waits_and_the_newcomer_is_dropped():
    uploads = Uploads(100)
    with ExitStack() as stack:
        whole = begun(uploads, stack, bytes(90), 1000)
        whole.whole = True
        newest = begun(uploads, stack, bytes(20), 0.01)
        assert (whole.dropped, newest.dropped, len(whole.content)) == (False, True, 90)
    with pytest.raises(ConnectionError), uploads.one() as body:  # a visitor leaves: the room is free again
        body.take(bytes(100))
        raise ConnectionError
    assert uploads.kept_bytes == 0


def test_the_bound_holds_for_random_uploads():
    random = np.random.default_rng(0)
    uploads, open_ones = Uploads(1_000), []
    most = 0
    for _ in range(3_000):
        with ExitStack() as stack:
            if len(open_ones) < 20:
                open_ones.append((begun(uploads, stack, b"", random.uniform(0, 30)), stack.pop_all()))
        body, closing = open_ones[random.integers(len(open_ones))]
        before = [other for other, _ in open_ones if other.whole]
        if not body.whole:
            body.take(bytes(random.integers(200)))
            uploads.make_room()
            body.whole = not body.dropped and random.random() < 0.1
        assert not any(other.dropped for other in before)
        most = max(most, uploads.kept_bytes)
        assert uploads.kept_bytes == sum(len(other.content) for other, _ in open_ones)
        if body.dropped or (body.whole and random.random() < 0.3):
            closing.close()
            open_ones = [pair for pair in open_ones if pair[0] is not body]
    assert 900 < most <= 1_000
