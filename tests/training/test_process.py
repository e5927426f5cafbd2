"""The process of a run: one at a time writes it; torch's switch goes back; freed memory is reused."""

import contextlib
import os
import signal
import subprocess
import sys
import threading
import time

import pytest
import torch
from PIL import Image
from tests.trust.apart import start, waited

from derender.data import read_images
from derender.training import resolve, train
from derender.training.process import LOCK_FILE, deterministic_algorithms, locked


@pytest.mark.parametrize("before", [False, True])
@pytest.mark.parametrize("deterministic", [False, True])
def test_the_switch_is_turned_back(before, deterministic):
    torch.use_deterministic_algorithms(before, warn_only=before)
    try:
        with pytest.raises(KeyError), deterministic_algorithms(deterministic):
            assert torch.are_deterministic_algorithms_enabled() is deterministic
            raise KeyError
        assert torch.are_deterministic_algorithms_enabled() is before
        assert torch.is_deterministic_algorithms_warn_only_enabled() is before
    finally:
        torch.use_deterministic_algorithms(False)


FRESH = """
import resource, torch
from derender.training.process import freed_memory_kept
def faults():  # minor ones, while a block of 64 MB is filled and freed twenty times
    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    [torch.ones(16 * 2**20) is None for _ in range(20)]
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before
outside = faults()
cpu = torch.device("cpu")
with freed_memory_kept(cpu) as kept, freed_memory_kept(cpu) as twice:
    print(int(kept), outside, faults(), flush=True)
assert not twice
"""


def test_freed_memory_is_reused():
    """In a fresh process, where no block is free to be reused."""
    ended = subprocess.run([sys.executable, "-c", FRESH], capture_output=True, text=True, timeout=120)
    assert ended.returncode == 0, ended.stderr
    kept, outside, inside = map(int, ended.stdout.split())
    assert not kept or (outside > 1_000 and inside < outside / 4)  # the C library may have no mallopt


@pytest.fixture
def other(tmp_path, tmp_path_factory):
    """A process that writes the run."""

    def hold() -> None:
        with locked(tmp_path / "run"):
            (place / "held").touch()
            time.sleep(600)

    place = tmp_path_factory.mktemp("other")
    child = start(hold, place / "log")
    while not (place / "held").exists() and waited(child, 0.01) is None:
        pass
    yield child
    with contextlib.suppress(ProcessLookupError):
        os.kill(child, signal.SIGKILL)


@pytest.mark.filterwarnings("ignore:.*fork:DeprecationWarning")  # while threads run
def test_a_second_process_neither_writes_nor_trains_and_a_killed_one_is_taken_over(other, tmp_path):
    run = tmp_path / "run"
    with pytest.raises(ValueError, match="run is being written by another process: wait for it"):
        locked(run).__enter__()
    for number in range(12):
        Image.new("RGB", (32, 32), (20 * number, 0, 0)).save(tmp_path / f"{number}.png")
    images = read_images(tmp_path, 32)
    with pytest.raises(ValueError, match="being written by another process"):
        train(resolve("small", ["image_size=32"]), images, run, resume=True)
    assert [file.name for file in run.iterdir()] == [LOCK_FILE]
    os.kill(other, signal.SIGKILL)
    assert waited(other, 60) == -signal.SIGKILL
    (run / "config.yaml").touch()
    with locked(run), locked(run):
        assert (run / LOCK_FILE).exists()
    assert (run / "config.yaml").exists()


def test_a_folder_made_for_the_lock_goes_with_it(tmp_path):
    with locked(tmp_path / "run"):
        assert (tmp_path / "run").is_dir()
    assert not (tmp_path / "run").exists()


def test_a_lock_that_is_a_link_or_a_pipe_changes_no_other_file(tmp_path):
    (tmp_path / "precious").write_text("precious")
    (tmp_path / LOCK_FILE).symlink_to(tmp_path / "precious")
    with pytest.raises(OSError, match=LOCK_FILE):
        locked(tmp_path).__enter__()
    (tmp_path / LOCK_FILE).unlink()
    os.mkfifo(tmp_path / LOCK_FILE)
    with contextlib.suppress(ValueError, OSError):
        locked(tmp_path).__enter__()
    assert (tmp_path / "precious").read_text() == "precious"


def test_of_many_threads_one_at_a_time_writes(tmp_path):
    at_once, most, done, refused = 0, 0, 0, 0

    def work() -> None:
        nonlocal at_once, most, done, refused
        for _ in range(30):
            try:
                with locked(tmp_path / "run"):
                    at_once += 1
                    most, done = max(most, at_once), done + 1
                    time.sleep(0.001)
                    at_once -= 1
            except ValueError:
                refused += 1

    threads = [threading.Thread(target=work) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert most == 1 and done and done + refused == 120
