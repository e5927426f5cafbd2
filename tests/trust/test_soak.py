"""The verdicts of a soak: growth is called growth, and wavering is not; its eyes, and its clients."""

import importlib
import threading
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

HOUR = np.arange(0, 3600, 10.0)
WAVERING = 500 + np.random.default_rng(0).normal(0, 15, HOUR.size)
PEAK = np.where(np.arange(HOUR.size) == 200, 900, WAVERING)


@pytest.fixture
def measure(monkeypatch):
    monkeypatch.syspath_prepend(str(Path(__file__).parent))
    return importlib.import_module("soaking.measure")


def judged(measure, values, quantity="private_mb"):
    return measure.verdict(list(zip(HOUR, values, strict=True)), measure.BOUNDS[quantity])


@pytest.mark.parametrize(
    ("values", "quantity", "grows"),
    [
        pytest.param(WAVERING, "private_mb", False, id="wavers"),
        pytest.param(WAVERING + 300 * np.minimum(HOUR / 800, 1), "private_mb", False, id="warms up"),
        pytest.param(PEAK, "private_mb", False, id="one peak"),
        pytest.param(WAVERING + 60 * HOUR / 3600, "private_mb", True, id="leaks"),
        pytest.param(WAVERING + 40.0 * (HOUR > 2500), "private_mb", True, id="jumps late"),
        pytest.param(40 + np.floor(HOUR / 300), "descriptors", True, id="leaks one by one"),
        pytest.param(40 + np.arange(HOUR.size) % 4, "descriptors", False, id="a few more or less"),
    ],
)
def test_growth_is_found_through_the_noise_and_wavering_is_flat(measure, values, quantity, grows):
    assert judged(measure, values, quantity).grows is grows


def test_a_verdict_tells_slope_median_and_peak(measure):
    leak, peak = judged(measure, WAVERING + 60 * HOUR / 3600), judged(measure, PEAK)
    assert leak.low < 60 < leak.high and peak.low < 0 < peak.high
    assert peak.largest == 900 and peak.median == pytest.approx(500, abs=3)
    with pytest.raises(ValueError, match="soak for longer"):
        measure.verdict([(0.0, 1.0), (1.0, 1.0)], (1.0, 0.0))
    rows = measure.markdown({"view": {"files": judged(measure, HOUR, "files")}}).splitlines()
    assert rows[-1].startswith("| view | files |") and rows[-1].endswith("| GROWS |")
    assert len({row.count("|") for row in rows}) == 1


def test_an_answer_that_does_not_fit_is_a_failure_and_one_that_does_is_timed(measure):
    clients = importlib.import_module("soaking.clients")
    answers = clients.Answers()
    visitor = clients.Visitor(1, 0, [], 0, 1e-6, answers, threading.Event())

    def answering(status: int, body: bytes) -> SimpleNamespace:
        answer = SimpleNamespace(status=status, read=lambda: body)
        return SimpleNamespace(request=lambda *_: None, getresponse=lambda: answer, close=lambda: None)

    for status, body in ((200, b"no picture"), (503, clients.PNG)):
        visitor.line = answering(status, body)
        with pytest.raises(clients.Unfit):
            visitor.drag(visitor.question("a", {}))
    visitor.line = answering(200, clients.PNG)
    visitor.drag(visitor.question("a", {}))
    assert len(answers.waits) == 1 and "status 503" in answers.failures[1][1]
    told = answers.told()
    assert (told["answers"], told["failed"], told["slowest"]) == (1, 2, "view") and told["longest_ms"] > 0
