"""Two processes train as one does: same losses, same gradients, same images, one voice."""

import json
import os
import socket
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from derender.data import read_images
from derender.training import resolve, train
from derender.training.batches import Batches
from derender.training.distributed import Ranks
from derender.training.run_folder import read_metrics

TINY = [
    *(
        "image_size=32",
        "width=8",
        "light_width=4",
        "batch_size=8",
        "perceptual=self",
        "self_features_steps=2",
    ),
    *("validate_every=16", "checkpoint_every=16", "learning_rate=1e-4", "warmup_images=0", "final_rate=1"),
    "loocc=light+camera",
]


def two_processes(*arguments: str) -> list[tuple[int, str]]:
    """Run python with these arguments twice, as torchrun would; exit codes and what was said."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    common = {
        **os.environ, "WORLD_SIZE": "2", "LOCAL_WORLD_SIZE": "2", "GROUP_RANK": "0",
        "TORCHELASTIC_RUN_ID": "test",
        "MASTER_ADDR": "127.0.0.1", "MASTER_PORT": str(port), "GLOO_SOCKET_IFNAME": "lo",
        "OMP_NUM_THREADS": "1", "NUMBA_NUM_THREADS": "1",
    }  # fmt: skip
    running = [
        subprocess.Popen(
            [sys.executable, *arguments],
            env={**common, "RANK": str(rank), "LOCAL_RANK": str(rank)},
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
        )
        for rank in range(2)
    ]
    try:
        said = [process.communicate(timeout=280)[0] for process in running]
    finally:
        for process in running:
            process.kill()
    return [(process.returncode, words) for process, words in zip(running, said, strict=True)]


@pytest.fixture
def one_thread() -> Iterator[None]:
    """As many threads as each of the two processes has: sums of several are rounded otherwise."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


def settings(*changes: str) -> list[str]:
    return [part for change in (*TINY, *changes) for part in ("--set", change)]


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    made = tmp_path_factory.mktemp("pictures")
    noise = np.random.default_rng(0)
    for number in range(40):
        pixels = noise.integers(0, 256, (4, 4, 3), dtype=np.uint8).repeat(8, axis=0).repeat(8, axis=1)
        Image.fromarray(pixels).save(made / f"{number:03d}.png")
    return made


def test_two_processes_have_the_losses_and_gradients_of_one_with_the_whole_batch(tmp_path):
    ended = two_processes(str(Path(__file__).with_name("one_rank.py")), str(tmp_path / "found.json"))
    assert [code for code, _ in ended] == [0, 0], ended
    found = json.loads((tmp_path / "found.json").read_text())
    assert found["count"] == 2
    assert found["gathered"] == [0, 0, 1, 1]
    assert found["gradient"] == [0, 3, 6, 9]  # both ranks' wishes, once and twice the row's number
    for step in found["steps"]:
        assert step["loocc"] > 0
        assert step["terms"] < 1e-10, step
        assert step["gradients"] < 1e-9, step


@pytest.mark.usefixtures("one_thread")
def test_two_processes_train_one_run_that_one_process_can_go_on_with(folder, tmp_path):
    run = tmp_path / "shared"
    command = ["-m", "derender", "train", "--data", str(folder), "--preset", "small", "--device", "cpu"]
    (code, said), (other_code, silence) = two_processes(
        *command, "--out", str(run), *settings("images=32")
    )  # fmt: skip
    assert (code, other_code) == (0, 0), (said, silence)
    assert "derender" not in silence
    assert "pictures" not in silence
    assert "stopped by: images" in said
    environment = json.loads((run / "environment.json").read_text())
    assert environment["device"] == "2 x cpu"
    pictures = read_images(str(folder), 32)
    train(resolve("small", [*TINY, "images=32"]), pictures, tmp_path / "alone", accelerator="cpu")
    for place in (run, tmp_path / "alone"):
        train(resolve("small", [*TINY, "images=48"]), pictures, place, resume=True, accelerator="cpu")
    rows, expected = read_metrics(run), read_metrics(tmp_path / "alone")
    assert [(row["kind"], row["images"]) for row in rows] == [
        (row["kind"], row["images"]) for row in expected
    ]
    assert [row["images"] for row in rows if row["kind"] == "validation"] == [16, 32, 48]
    for row, same in zip(rows, expected, strict=True):
        for name in same.keys() - {"kind", "images", "seconds", "images_per_second", "waiting"}:
            # loose on purpose: Adam's first steps have the size of the rate however small a gradient is
            assert row[name] == pytest.approx(same[name], rel=1e-3, abs=1e-4), (row["images"], name)


def test_what_fails_in_all_processes_is_said_once(folder, tmp_path):
    ended = two_processes(
        *("-m", "derender", "train", "--data", str(folder), "--preset", "small", "--device", "cpu"),
        *("--out", str(tmp_path / "run"), *settings("batch_size=7")),
    )
    said = "".join(words for _, words in ended)
    assert [code for code, _ in ended] == [2, 2], said
    complaints = [line for line in said.splitlines() if line.startswith("derender:")]
    assert len(complaints) == 1, said
    assert "batch_size 7 cannot be shared evenly by 2 processes: set batch_size=6" in complaints[0]
    assert "Traceback" not in said
    assert not (tmp_path / "run").exists()


def test_ranks_have_the_rows_of_the_batch_of_one_process_between_them():
    images = torch.randint(0, 256, (13, 3, 4, 4), dtype=torch.uint8)
    batches = Batches(images, 6, seed=3, horizontal_flips=True)
    for position in (0, 3):
        parts = [batches.at(position, Ranks(rank, 3)) for rank in range(3)]
        assert torch.equal(torch.cat(parts), batches.at(position))
