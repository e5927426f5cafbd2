"""Two processes train as one does: same losses, same gradients, same images, one voice."""

import importlib
import json
import re
import socket
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import pytest
import torch
from tests.cli.conftest import noise
from tests.training.one_rank import one_rank
from tests.trust.apart import start, waited

from derender.data import read_images
from derender.training import resolve, train
from derender.training.batches import Batches
from derender.training.distributed import Ranks
from derender.training.run_folder import read_metrics

pytestmark = pytest.mark.filterwarnings("ignore:.*fork:DeprecationWarning")  # while threads run
TINY = [
    *("image_size=32", "width=8", "light_width=4", "batch_size=8"),
    *("perceptual=self", "self_features_steps=2"),
    *("validate_every=16", "checkpoint_every=16", "learning_rate=1e-4", "warmup_images=0", "final_rate=1"),
    *("loocc=light+camera", "whitening.pictures=8", "whitening.spatial=false", "directions=8"),
]


def free_port() -> str:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        return str(free.getsockname()[1])


def two_processes(commands: list[list[str]], place: Path) -> list[str]:
    """What each of two processes prints that are begun as by torchrun; the first writes found.json."""
    common = {
        "WORLD_SIZE": "2", "LOCAL_WORLD_SIZE": "2", "TORCHELASTIC_RUN_ID": "test",
        "MASTER_ADDR": "127.0.0.1", "MASTER_PORT": free_port(), "GLOO_SOCKET_IFNAME": "lo", "GROUP_RANK": "0",
    }  # fmt: skip
    given = (commands, place / "found.json", free_port())
    for slow in ("torch._dynamo", "derender.learn.runs", "derender.report.run"):
        importlib.import_module(slow)  # once for both
    own = {rank: common | {"RANK": rank, "LOCAL_RANK": rank} for rank in "01"}
    children = [start(partial(one_rank, own[rank], *given), place / rank) for rank in own]
    ended = [waited(child, 120) for child in children]
    printed = [(place / rank).read_text() for rank in "01"]
    assert ended == [0, 0], printed
    return printed


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
    return noise(tmp_path_factory.mktemp("pictures"), 40)


@pytest.fixture(scope="module")
def told(folder, tmp_path_factory) -> tuple[dict, list[list[str]], Path]:
    """Two processes that are refused a training, train, and compare steps.

    Gives what the steps came to; what each process printed of each command, its exit code last; and the run.
    """
    place = tmp_path_factory.mktemp("told")
    train_words = ["train", "--data", str(folder), "--preset", "small", "--device", "cpu"]
    commands = [
        [*train_words, "--out", str(place / "refused"), *settings("batch_size=7")],
        [*train_words, "--out", str(place / "run"), *settings("images=32")],
    ]
    ended = two_processes(commands, place)
    printed = [re.split(r"(?<=\nended with \d)\n", words)[:2] for words in ended]
    return json.loads((place / "found.json").read_text()), printed, place


def test_two_processes_have_the_losses_and_gradients_of_one_with_the_whole_batch(told):
    result = told[0]
    assert result["count"] == 2
    for step in result["steps"]:
        assert step["loocc"] > 0
        assert step["terms"] < 1e-10, step
        assert step["gradients"] < 1e-9, step


@pytest.mark.usefixtures("one_thread")
def test_two_processes_train_one_run_that_one_process_can_go_on_with(folder, told, tmp_path):
    printed, silence = (words[1] for words in told[1])
    assert printed.endswith("ended with 0") and silence.endswith("ended with 0")
    assert "derender" not in silence and "images" not in silence
    assert "stopped by: images" in printed
    run = told[2] / "run"
    assert json.loads((run / "environment.json").read_text())["device"] == "2 x cpu"
    images = read_images(str(folder), 32)
    train(resolve("small", [*TINY, "images=32"]), images, tmp_path / "alone", accelerator="cpu")
    for place in (run, tmp_path / "alone"):
        train(resolve("small", [*TINY, "images=48"]), images, place, resume=True, accelerator="cpu")
    rows, expected = read_metrics(run), read_metrics(tmp_path / "alone")
    at = [[(row["kind"], row["images"]) for row in some] for some in (rows, expected)]
    assert at[0] == at[1]
    assert [row["images"] for row in rows if row["kind"] == "validation"] == [16, 32, 48]
    for row, same in zip(rows, expected, strict=True):
        for name in same.keys() - {"kind", "images", "seconds", "images_per_second", "waiting"}:
            # loose on purpose: Adam's first steps have the size of the rate however small a gradient is
            assert row[name] == pytest.approx(same[name], rel=1e-3, abs=1e-4), (row["images"], name)


def test_what_fails_in_all_processes_is_said_once(told):
    each = [words[0] for words in told[1]]
    printed = "\n".join(each)
    assert all(words.endswith("ended with 2") for words in each), printed
    complaints = [line for line in printed.splitlines() if line.startswith("derender:")]
    assert len(complaints) == 1, printed
    assert "batch_size 7 cannot be shared evenly by 2 processes: set batch_size=6" in complaints[0]
    assert "Traceback" not in printed
    assert not (told[2] / "refused").exists()


def test_ranks_have_the_rows_of_the_batch_of_one_process_between_them():
    images = torch.randint(0, 256, (13, 3, 4, 4), dtype=torch.uint8)
    batches = Batches(images, 6, seed=3, horizontal_flips=True)
    for position in (0, 3):
        parts = [batches.at(position, Ranks(rank, 3)) for rank in range(3)]
        assert torch.equal(torch.cat(parts), batches.at(position))
