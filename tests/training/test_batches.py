"""Batches are a function of seed and position; the learning rate one of images seen."""

import threading

import pytest
import torch

from derender.training import batches as batches_module
from derender.training.batches import Batches, Reader, random_stream
from derender.training.config import OptimiserSettings


def numbered(count: int) -> torch.Tensor:
    """Images whose pixels hold their own number, with a bright column at the left."""
    images = torch.arange(count, dtype=torch.uint8)[:, None, None, None].repeat(1, 3, 4, 4)
    images[..., 0] = 255
    return images


def numbers(batch: torch.Tensor) -> list[int]:
    return (batch[:, 0, 0, 1] * 255).round().int().tolist()


def test_an_epoch_shows_every_image_once_in_a_new_order_each_time():
    batches = Batches(numbered(12), 4, seed=3, horizontal_flips=False)
    epochs = [[n for i in range(3) for n in numbers(batches.at(3 * epoch + i))] for epoch in range(2)]
    assert sorted(epochs[0]) == sorted(epochs[1]) == list(range(12))
    assert epochs[0] != epochs[1]


def test_rows_of_a_larger_set_are_batched_as_if_they_were_copied(monkeypatch):
    rows = torch.arange(1, 40, 3).numpy()
    part = Batches(numbered(40), 4, 3, True, rows)
    copied = Batches(numbered(40)[rows], 4, 3, True)
    assert all(torch.equal(part.at(position), copied.at(position)) for position in range(7))
    assert torch.equal(part.sample(), copied.sample())
    assert not torch.equal(part.at(3), Batches(numbered(40), 4, 8, True, rows).at(3))
    monkeypatch.setattr(batches_module, "SAMPLED", 5)
    assert part.sample()[:, 0, 0, 1].tolist() == [1, 10, 19, 28, 37]


def test_about_half_of_the_images_are_mirrored():
    batches = Batches(numbered(200), 100, 0, True)
    mirrored = torch.cat([batches.at(i) for i in range(10)])[:, 0, 0, -1] == 1
    assert 0.42 < mirrored.float().mean() < 0.58


def test_a_reader_gives_the_same_batches_in_any_order():
    batches = Batches(numbered(12), 4, 3, True)
    reader = Reader(batches)
    for position in (0, 1, 2, 3, 7, 8, 2):
        assert torch.equal(reader.at(position), batches.at(position))
    reader.close()


def test_waiting_is_what_was_not_read_ahead(monkeypatch):
    """Reading takes five seconds of a clock that nothing else moves; in a thread none, for the fourth two."""
    clock, asked, waited, read = [0.0], threading.Event(), [], Batches.read

    def slow(batches, position, *ranks):
        if threading.current_thread() is threading.main_thread():
            clock[0] += 5
        elif position == 3:  # read ahead, and still not there when it is asked for
            asked.wait(10)
            clock[0] += 2
        return read(batches, position, *ranks)

    def now() -> float:
        result = clock[0]
        if len(waited) == 3:
            asked.set()
        return result

    monkeypatch.setattr(Batches, "read", slow)
    monkeypatch.setattr(batches_module.time, "perf_counter", now)
    reader = Reader(Batches(numbered(12), 4, 3, False))
    for position in (0, 1, 2, 3, 9):
        reader.at(position)
        waited.append(reader.waited_s)
    reader.close()
    assert waited == [5, 5, 5, 7, 12]


def test_streams_differ_by_purpose_and_position_and_repeat():
    keys = [(purpose, position) for purpose in ("order", "flip", "perturb") for position in range(5)]
    draws = {key: torch.rand(4, generator=random_stream(0, *key)).tolist() for key in keys}
    assert len({tuple(value) for value in draws.values()}) == len(draws)
    assert torch.rand(4, generator=random_stream(0, "flip", 3)).tolist() == draws["flip", 3]


def test_learning_rate_warms_up_then_falls_along_a_cosine():
    settings = OptimiserSettings(learning_rate=1e-3, warmup_images=100, final_rate=0.1)
    rates = [settings.rate(images, 1100) for images in (0, 49, 99, 100, 600, 1100, 5000)]
    assert rates == pytest.approx([1e-5, 5e-4, 1e-3, 1e-3, 5.5e-4, 1e-4, 1e-4])
    assert OptimiserSettings().rate(0, 100) == OptimiserSettings().rate(99, 100) == 1e-4
