"""A kill at any step of writing leaves something whole; what is damaged is passed over and told."""

import os
import shutil
import subprocess
import sys
import warnings
from pathlib import Path

import pytest
import torch
from tests.trust.apart import start, waited

from derender.storage import atomic
from derender.storage.atomic import CHECKSUMS, Damaged, DamageNoticed, atomic_folder, check_seal, seal
from derender.training import checkpoint
from derender.training.checkpoint import DamagedCheckpoint, TrainState, load_checkpoint, resume_from

ROOT = Path(__file__).resolve().parents[2]
STEPS = ("open", "os.", "shutil.", "tempfile.")
"""Beginnings of the names of Python's audit events before which a process can be killed."""


class Net:
    """A layer and its optimiser, moved a step further with every save."""

    def __init__(self):
        self.model = torch.nn.Linear(3, 2)
        self.optimiser = torch.optim.Adam(self.model.parameters())

    def save(self, run: Path, images: int) -> None:
        self.optimiser.zero_grad()
        self.model(torch.ones(1, 3)).sum().backward()
        self.optimiser.step()
        state = TrainState(images=images)
        checkpoint.save_checkpoint(run / "last", self.model, self.optimiser, state, previous=run / "previous")

    def resumed(self, run: Path) -> tuple[int, str | None]:
        state, note = resume_from(run / "last", run / "previous", self.model, self.optimiser)
        return state.images, note


@pytest.fixture
def net() -> Net:
    return Net()


@pytest.fixture
def run(net, tmp_path) -> Path:
    """A run whose last checkpoint is of 16 images, the previous one of 8."""
    for images in (8, 16):
        net.save(tmp_path / "run", images)
    return tmp_path / "run"


def killed_at(step: int, work) -> bool:
    """Do the work in a process that is gone just before its ``step``-th touch of a file; whether it was."""

    def until_then() -> int:
        touched = 0

        def count(event: str, _: tuple[object, ...]) -> None:
            nonlocal touched
            touched += event.startswith(STEPS)
            if touched == step:
                os._exit(9)

        sys.addaudithook(count)
        work()
        os._exit(0)

    code = waited(start(until_then, Path(os.devnull)), 20)
    assert code in (0, 9)
    return code == 9


@pytest.mark.filterwarnings("ignore:.*fork:DeprecationWarning")  # while threads run
@pytest.mark.parametrize("exchange", [True, False])
def test_a_kill_at_any_step_of_writing_a_checkpoint_leaves_a_whole_one(
    net, run, tmp_path, monkeypatch, exchange
):
    if not exchange:
        monkeypatch.setattr(atomic, "_exchanged", lambda one, other: False)
    seen, step = set(), 0
    while True:
        step += 1
        copy = tmp_path / f"copy{step}"
        shutil.copytree(run, copy)
        killed = killed_at(step, lambda here=copy: net.save(here, 24))
        with warnings.catch_warnings(record=True) as told:
            warnings.simplefilter("always")
            images, note = net.resumed(copy)
        assert images in (16, 24)
        assert bool(told) == (note is not None) and (note is None or not exchange)
        seen.add(images)
        if not killed:
            break
        if step % 6:
            continue
        net.save(copy, 32)
        assert net.resumed(copy) == (32, None)
    assert step > 20 and seen == {16, 24}
    assert sorted(entry.name for entry in copy.iterdir()) == ["last", "previous"]
    assert load_checkpoint(copy / "previous", net.model, None).images == 16


def flip(file: Path, at: float) -> None:
    content = bytearray(file.read_bytes())
    content[int(at * len(content))] ^= 4
    file.write_bytes(content)


DAMAGES = {
    "first byte": lambda file: flip(file, 0),
    "byte in the middle": lambda file: flip(file, 0.5),
    "last byte": lambda file: flip(file, 0.999999),
    "cut": lambda file: file.write_bytes(file.read_bytes()[:-7]),
    "longer": lambda file: file.write_bytes(file.read_bytes() + b"\0"),
    "empty": lambda file: file.write_bytes(b""),
    "missing": Path.unlink,
}


@pytest.mark.parametrize("file", ["model.safetensors", "optimiser.safetensors", "state.json", CHECKSUMS])
@pytest.mark.parametrize("damage", DAMAGES)
def test_a_damaged_last_checkpoint_falls_back_to_the_one_before_and_says_so(net, run, file, damage):
    DAMAGES[damage](run / "last" / file)
    with pytest.warns(DamageNoticed, match=r"last is damaged \(.*going on from .* before it, of 8 images"):
        images, note = net.resumed(run)
    assert images == 8 and note is not None
    DAMAGES[damage](run / "previous" / file)
    with pytest.raises(DamagedCheckpoint, match=r"previous is damaged .* begin this run again with --resume"):
        net.resumed(run)


def test_a_missing_last_checkpoint_falls_back_too_and_one_of_another_model_is_no_damage(net, run):
    other = torch.nn.Linear(4, 2)
    with pytest.raises(ValueError, match=r"last is of another model \(.*shape"):
        resume_from(run / "last", run / "previous", other, torch.optim.Adam(other.parameters()))
    shutil.rmtree(run / "last")
    with pytest.warns(DamageNoticed, match="last is missing: going on"):
        assert net.resumed(run)[0] == 8


def test_a_checkpoint_from_the_future_says_so(net, run):
    state = run / "last" / "state.json"
    state.write_text(state.read_text().replace('"format": 1', '"format": 9'))
    (run / "last" / CHECKSUMS).unlink()
    seal(run / "last")
    with pytest.raises(ValueError, match="made in format 9, this version reads up to 1: update derender"):
        net.resumed(run)


def test_checkpoints_of_earlier_versions_have_no_seal_and_are_read(net, run):
    (run / "last" / CHECKSUMS).unlink()
    state = run / "last" / "state.json"
    state.write_text(state.read_text().replace('"format": 1, ', ""))
    assert net.resumed(run) == (16, None)


def test_a_checkpoint_that_reads_back_otherwise_is_not_taken(net, run, monkeypatch):
    write = Path.write_bytes
    monkeypatch.setattr(Path, "write_bytes", lambda file, content: write(file, content[:-1] + b"!"))
    with pytest.raises(OSError, match="reads back other than it was written: check the disk; the old one is"):
        net.save(run, 24)
    assert net.resumed(run) == (16, None)
    assert sorted(entry.name for entry in run.iterdir()) == ["last", "previous"]


@pytest.mark.parametrize(
    ("content", "message"),
    [(b"bab", "^b has changed since it was written: its checksum differs"), (b"bb", "2 of 3 bytes")],
)
def test_a_seal_names_what_has_changed(tmp_path, content, message):
    with atomic_folder(tmp_path / "sealed") as folder:
        (folder / "a").write_bytes(b"aaa")
        (folder / "b").write_bytes(b"bbb")
        seal(folder)
    check_seal(tmp_path / "sealed")
    (tmp_path / "sealed" / "b").write_bytes(content)
    with pytest.raises(Damaged, match=message):
        check_seal(tmp_path / "sealed")


def test_a_killed_embedding_is_resumed_to_the_same_table(tiny, tmp_path):
    """Three real kills; the script makes as many as it is told, and kills training and comparing too."""
    told = ["--what", "embed", "--kills", "3", "--seed", "1", "--no-mount", "--pictures", "24", "--model"]
    told = [sys.executable, ROOT / "tests" / "trust" / "kills.py", *told, tiny]
    place = {**os.environ, "TMPDIR": str(tmp_path)}
    done = subprocess.run(told, capture_output=True, text=True, timeout=280, env=place)
    assert done.returncode == 0, done.stdout + done.stderr
    last = done.stdout.strip().splitlines()[-1]
    assert last.startswith("embed: 3 kills") and last.endswith(" 0 faults")
