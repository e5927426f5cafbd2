"""First appearances, against a dictionary; and the bounded queue between threads."""

import threading
import time

import numpy as np
import pytest

from derender.data import SeenPixels, ahead


def test_first_appearances_are_those_a_dictionary_knows():
    generator = np.random.default_rng(0)
    seen, known, number = SeenPixels(), {}, 0
    for count in generator.integers(0, 60, 80):
        digests = [int(value).to_bytes(16, "big") for value in generator.integers(0, 1500, count)]
        rows = list(range(number, number + count))
        expected = [known.setdefault(digest, row) for digest, row in zip(digests, rows, strict=True)]
        assert seen.first(digests, rows).tolist() == expected
        number += count
    assert (
        sum(len(keys) for keys, _ in seen._runs) == len(known) and len(seen._runs) <= np.log2(len(known)) + 1
    )


def test_zero_bytes_at_the_end_of_a_digest_count():
    digests = [b"\0" * 16, b"a" + b"\0" * 15, b"a" * 16, b"\0" * 15 + b"a"]
    assert SeenPixels().first([*digests, *digests], range(8)).tolist() == [0, 1, 2, 3, 0, 1, 2, 3]


def test_a_reader_is_never_further_ahead_than_asked():
    made = []

    def items():
        for number in range(50):
            made.append(number)
            yield number

    taken = []
    with ahead(items(), depth=3) as ready:
        for item in ready:
            taken.append(item)
            time.sleep(0.002)
            assert len(made) - len(taken) <= 3 + 1
    assert taken == list(range(50))


def test_errors_arrive_and_leaving_ends_the_thread():
    def failing():
        yield 1
        raise ValueError("broken pipe of images")

    with pytest.raises(ValueError, match="broken pipe of images"), ahead(failing()) as ready:
        assert list(ready) == [1]
    closed = []

    def endless():
        try:
            while True:
                yield 0
        finally:
            closed.append(True)

    with ahead(endless()) as ready:
        assert next(ready) == 0
    assert closed and not [thread for thread in threading.enumerate() if thread.name.startswith("read")]
