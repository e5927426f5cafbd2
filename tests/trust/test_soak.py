"""The verdicts of a soak: growth is called growth, and wavering is not; its eyes, and its clients."""

import importlib
import subprocess
import sys
import threading
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

HOUR = np.arange(0, 3600, 10.0)
WAVERING = np.random.default_rng(0).normal(0, 15, HOUR.size)


@pytest.fixture(autouse=True)
def beside(monkeypatch):
    """The script's own folder among those that modules are looked for in, as when it is run."""
    monkeypatch.syspath_prepend(str(Path(__file__).parent))


@pytest.fixture
def flat():
    return importlib.import_module("soaking.flat")


@pytest.fixture
def measure():
    return importlib.import_module("soaking.measure")


def judged(flat, values, quantity="private_mb"):
    return flat.verdict(flat.Series(HOUR.tolist(), values.tolist()), flat.BOUNDS[quantity])


def test_a_series_that_only_wavers_is_flat(flat):
    found = judged(flat, 500 + WAVERING)
    assert not found.grows
    assert found.low < 0 < found.high
    assert found.median == pytest.approx(500, abs=3)


def test_what_grows_in_the_first_quarter_only_is_flat(flat):
    assert not judged(flat, 500 + 300 * np.minimum(HOUR / 800, 1) + WAVERING).grows


def test_a_leak_is_found_through_the_noise(flat):
    found = judged(flat, 500 + 60 * HOUR / 3600 + WAVERING)
    assert found.grows
    assert found.low < 60 < found.high


def test_a_late_jump_is_found(flat):
    assert judged(flat, 500 + 40.0 * (HOUR > 2500) + WAVERING).grows


def test_a_single_peak_is_no_growth_but_is_told(flat):
    values = 500 + WAVERING
    values[200] = 900
    found = judged(flat, values)
    assert not found.grows
    assert found.largest == 900


def test_descriptors_that_leak_one_by_one_are_found(flat):
    assert judged(flat, 40 + np.floor(HOUR / 300), "descriptors").grows
    assert not judged(flat, 40 + np.arange(HOUR.size) % 4, "descriptors").grows


def test_few_samples_are_refused(flat):
    with pytest.raises(ValueError, match="soak for longer"):
        flat.verdict(flat.Series([0.0, 1.0], [1.0, 1.0]), (1.0, 0.0))


def test_the_table_says_what_grows(flat):
    rows = flat.markdown({"view": {"files": judged(flat, HOUR, "files")}}).splitlines()
    assert rows[-1].startswith("| view | files |")
    assert rows[-1].endswith("| GROWS |")
    assert len({row.count("|") for row in rows}) == 1


@pytest.mark.skipif(not Path("/proc/self/smaps_rollup").exists(), reason="/proc tells memory on Linux only")
def test_a_process_is_measured_with_its_child_and_what_it_opened(measure, tmp_path):
    program = (
        "import subprocess, sys; kept = bytearray(64 << 20); file = open(sys.argv[1], 'w')\n"
        "child = subprocess.Popen(['sleep', '60']); print('ready', flush=True)\n"
        "sys.stdin.read(); child.kill()"
    )
    command = [sys.executable, "-c", program, str(tmp_path / "open")]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, process_group=0) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == b"ready\n"
        found = measure.measured(process.pid)
        assert found["children"] == 1
        assert 64 < found["private_mb"] < 200
        assert found["private_mb"] < found["resident_mb"]
        assert found["descriptors"] >= 7
        assert found["threads"] == 2
        assert len(measure.of_group(process.pid)) == 2
        process.communicate(b"")
    assert measure.of_group(process.pid) == []


def test_files_are_counted_without_those_of_one_folder(measure, tmp_path):
    for name in ("a", "samples/b", "c/.d", "c/samples/e"):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).touch()
    assert measure.files_below(tmp_path, without="samples") == ["a", "c/.d"]


@dataclass
class Line:
    """A connection that gives one answer to everything."""

    status: int
    body: bytes

    def request(self, *sent: object) -> None:
        pass

    def getresponse(self) -> "Line":
        return self

    def read(self) -> bytes:
        return self.body

    def close(self) -> None:
        pass


def test_an_answer_that_does_not_fit_is_a_failure_and_one_that_does_is_timed():
    clients = importlib.import_module("soaking.clients")
    answers = clients.Answers()
    visitor = clients.Visitor(1, 0, [], 0, 1e-6, answers, threading.Event())
    for status, body in ((200, b"no picture"), (503, clients.PNG)):
        visitor.line = Line(status, body)
        with pytest.raises(clients.Unfit):
            visitor.drag(visitor.question({"picture": "a"}, None))
    visitor.line = Line(200, clients.PNG)
    visitor.drag(visitor.question({"picture": "a"}, None))
    assert sum(answers.failures.values()) == 2
    assert answers.since_last()[0] == 1
    assert answers.since_last()[0] == 0
    assert "status 503" in answers.said[1]
    rows = answers.rows()
    assert rows[-1]["answers"] == 1
    assert rows[-1]["failed"] == 2
