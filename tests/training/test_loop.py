"""The training loop: what a run leaves behind, exact resume, early stop, interruption, refusals."""

import dataclasses
import json
import os
import re
import shutil
import signal
import time
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from safetensors.torch import load_file
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from tests.training.conftest import assert_same_weights, noise_set, weights

import derender
from derender.cli import main
from derender.data import ImageSet
from derender.storage.atomic import DamageNoticed
from derender.training import TrainingInterrupted, loop, resolve, train, watch
from derender.training.batches import Batches
from derender.training.checkpoint import WEIGHTS_FILE, load_checkpoint
from derender.training.config import OptimiserSettings
from derender.training.loop import kept
from derender.training.run_folder import read_config, read_metrics
from derender.training.task import Progress
from derender.training.watch import SIGNS, Watcher

TINY = ["image_size=32", "width=8", "light_width=4", "perceptual=none", "batch_size=8", "checkpoint_every=32"]
TINY += ["validate_every=32", "sample_every=64", "deterministic=true", "learning_rate=1e-3"]
TINY += ["warmup_images=0", "final_rate=1", "whitening.pictures=0", "fitting.examples=0"]


@pytest.fixture(scope="module")
def pictures() -> ImageSet:
    return noise_set(60, cells=4)


def test_a_run_leaves_everything_named_in_the_design(pictures, tmp_path):
    def sheet(model, images):
        grey = model.reconstruct(images).image[0, 0].clamp(0, 1) * 255
        return Image.fromarray(grey.byte().cpu().numpy())

    seen: list[Progress] = []
    often = ["validate_every=16", "sample_every=32", "whitening.pictures=16"]
    config = resolve("small", [*TINY, *often, "images=64"])
    result = train(config, pictures, tmp_path / "run", sample_sheet=sheet, progress=seen.append)
    run = tmp_path / "run"
    assert result.stopped == "images"
    assert result.images == 64
    assert read_config(run) == config
    environment = json.loads((run / "environment.json").read_text())
    assert environment["data"]["pictures"] == 60
    assert environment["packages"]["torch"]
    assert sorted(path.name for path in (run / "samples").iterdir()) == ["000000032.png", "000000064.png"]
    assert {path.name for path in (run / "checkpoints").iterdir()} == {"last", "previous", "best"}
    assert derender.load(run).embed(torch.rand(2, 3, 32, 32))["geometry"].shape == (2, 256)
    kinds = [row["kind"] for row in read_metrics(run)]
    assert kinds.count("validation") == 4
    assert "train" in kinds
    assert [progress.done for progress in seen if progress.phase == "train"] == list(range(8, 65, 8))
    assert not [path for path in run.rglob("*") if path.suffix in (".pkl", ".pt", ".pth")]


def test_the_share_of_waiting_for_pictures_is_told(pictures, tmp_path, monkeypatch):
    read, seen = Batches.read, []

    def slow(batches, *where):
        time.sleep(0.1)
        return read(batches, *where)

    monkeypatch.setattr(Batches, "read", slow)
    result = train(resolve("small", [*TINY, "images=16"]), pictures, tmp_path / "run", progress=seen.append)
    (row,) = [row for row in read_metrics(tmp_path / "run") if row["kind"] == "train"]
    assert 0.09 < row["waiting"] * row["seconds"] <= row["seconds"]  # nobody could read the first one ahead
    assert 0 < result.waiting < 1
    assert seen[0].waiting == row["waiting"]
    events = EventAccumulator(str(tmp_path / "run" / "tensorboard")).Reload()
    assert events.Scalars("train/waiting")[0].value == pytest.approx(row["waiting"])


def test_a_mapped_set_is_trained_on_where_it_lies_and_gives_the_same_weights(pictures, tmp_path, monkeypatch):
    (tmp_path / "pictures").write_bytes(pictures.images.tobytes())
    images = np.memmap(tmp_path / "pictures", np.uint8, mode="c", shape=pictures.images.shape)
    held, sizes = dataclasses.replace(pictures, images=images), []
    read = Batches.read
    monkeypatch.setattr(Batches, "read", lambda self, *at: sizes.append(len(self.images)) or read(self, *at))
    config = resolve("small", [*TINY, "images=32"])
    train(config, held, tmp_path / "mapped", accelerator="cpu")
    train(config, pictures, tmp_path / "copied", accelerator="cpu")
    assert_same_weights(tmp_path / "mapped", tmp_path / "copied")
    assert sizes[0] == 60 > sizes[-1]


def ctrl_c_at(images: int, progress: Progress) -> None:
    if progress.done == images:
        os.kill(os.getpid(), signal.SIGINT)


def test_an_interrupted_run_is_saved_and_resumes_exactly(pictures, tmp_path):
    changing = ["loocc=light+camera", "images=80", "warmup_images=24", "final_rate=0.1"]
    config = resolve("small", [*TINY, *changing])
    with pytest.raises(TrainingInterrupted, match=r"stopped after 40 images and saved.*--resume"):
        train(config, pictures, tmp_path / "parts", progress=partial(ctrl_c_at, 40))
    assert train(config, pictures, tmp_path / "parts", resume=True).images == 80
    train(config, pictures, tmp_path / "whole")
    images = [row["images"] for row in read_metrics(tmp_path / "parts") if row["kind"] == "validation"]
    assert images[-1] == 80 and {32, 64} <= {*images}
    assert_same_weights(tmp_path / "whole", tmp_path / "parts")


def test_hollow_surfaces_are_inverted_where_a_resumed_run_inverts_them_too(pictures, tmp_path, monkeypatch):
    def until_64(watcher: Watcher, images: int, loss: float, latest: dict[str, float], *broken: str):
        return judge(watcher, images, loss, {**latest, "bulge": 0.2 if images > 64 else -0.5}, *broken)

    judge = Watcher.judge
    signs = [dataclasses.replace(one, grace_images=0) for one in SIGNS if one.invert is not None]
    monkeypatch.setattr(Watcher, "judge", until_64)
    monkeypatch.setattr(loop, "READ_EVERY_STEPS", 4)
    for name, value in {"PERSISTENCE_IMAGES": 40, "MEMORY_IMAGES": 8, "SIGNS": signs}.items():
        monkeypatch.setattr(watch, name, value)
    config = resolve("small", [*TINY, "images=80"])
    with pytest.raises(TrainingInterrupted):
        train(config, pictures, tmp_path / "parts", progress=partial(ctrl_c_at, 56))
    assert not [row for row in read_metrics(tmp_path / "parts") if row["kind"] == "note"]
    train(config, pictures, tmp_path / "parts", resume=True)
    assert train(config, pictures, tmp_path / "whole").stopped == "images"
    assert_same_weights(tmp_path / "whole", tmp_path / "parts")
    (note,) = [row for row in read_metrics(tmp_path / "parts") if row["kind"] == "note"]
    assert note["images"] == 64 and note["text"].startswith("surfaces were hollow")


def test_self_trained_perceptual_features_are_kept_for_the_resumed_run(pictures, tmp_path):
    settings = [*TINY, "perceptual=self", "self_features_steps=3"]
    train(resolve("small", [*settings, "images=32"]), pictures, tmp_path / "parts")
    before = (tmp_path / "parts" / "perceptual.safetensors").read_bytes()
    train(resolve("small", [*settings, "images=48"]), pictures, tmp_path / "parts", resume=True)
    assert (tmp_path / "parts" / "perceptual.safetensors").read_bytes() == before
    train(resolve("small", [*settings, "images=48"]), pictures, tmp_path / "whole")
    assert_same_weights(tmp_path / "whole", tmp_path / "parts")


def test_patience_ends_a_run_that_no_longer_improves_and_minutes_end_any(pictures, tmp_path, monkeypatch):
    config = resolve("small", [*TINY, "images=3200", "patience=2", "learning_rate=1e-12", "watch=false"])
    result = train(config, pictures, tmp_path / "run")
    assert result.stopped == "patience" and result.images <= 32 * 8
    rates, rate, reports = [], OptimiserSettings.rate, []
    monkeypatch.setattr(OptimiserSettings, "rate", lambda *of: rates.append(rate(*of)) or rates[-1])
    monkeypatch.setattr(loop, "READ_EVERY_STEPS", 1)
    config = resolve("small", [*TINY, "images=1000000", "minutes=0.03", "final_rate=0.1"])
    result = train(config, pictures, tmp_path / "short", progress=reports.append)
    assert result.stopped == "minutes" and (tmp_path / "short" / "checkpoints" / "last").is_dir()
    assert rates[0] > 9.9e-4 and rates[-1] < 4e-4  # schedules end with the minutes
    assert result.images <= reports[-1].total < 2 * result.images


@pytest.fixture(scope="module")
def worsening(pictures, tmp_path_factory):
    """A finished run that ends worse than it was: its rate is far too large."""
    folder = tmp_path_factory.mktemp("worsening") / "run"
    result = train(resolve("small", WORSENING), pictures, folder, accelerator="cpu")
    assert 0 < result.model_images < result.images == 96
    return folder, result


WORSENING = [*TINY, "images=96", "learning_rate=0.03", "watch=false"]


def model_of(run) -> dict[str, torch.Tensor]:
    return load_file(run / "model" / "model.safetensors")


def assert_model_is_of(run, checkpoint: str):
    wanted = weights(run, checkpoint)
    assert all(torch.equal(wanted[name], value) for name, value in model_of(run).items())


def test_the_model_is_of_the_best_validation_and_the_result_says_of_which(worsening):
    folder, result = worsening
    best = load_checkpoint(folder / "checkpoints" / "best", derender.load(folder), None)
    assert best.images == result.model_images
    assert_model_is_of(folder, "best")
    with pytest.raises(AssertionError):
        assert_model_is_of(folder, "last")


def test_the_command_says_of_which_weights_the_model_is(worsening, tmp_path, capsys):
    (tmp_path / "folder").mkdir()
    for number, picture in enumerate(noise_set(60, cells=4).images.transpose(0, 2, 3, 1)):
        Image.fromarray(picture).save(tmp_path / "folder" / f"{number:03d}.png")
    told = [part for setting in [*WORSENING, "split=[0.8,0.2,0]"] for part in ("--set", setting)]
    told += ["--preset", "small", "--data", str(tmp_path / "folder"), "--out", str(tmp_path / "run")]
    assert main(["train", *told]) == 0
    printed = " ".join(capsys.readouterr().err.split())
    assert re.search(r"the model has the weights of (32|64) images, the best on held-out ones", printed)
    assert main(["train", *told, "--set", "keep=last", "--resume"]) == 0
    assert "the model has the weights" not in capsys.readouterr().err
    assert_model_is_of(tmp_path / "run", "last")


def test_a_finished_run_gives_its_other_weights_when_resumed(worsening, pictures, tmp_path):
    run = Path(shutil.copytree(worsening[0], tmp_path / "run"))
    last = train(resolve("small", [*WORSENING, "keep=last"]), pictures, run, resume=True)
    assert last.model_images == last.images == 96
    assert_model_is_of(run, "last")
    best = train(resolve("small", WORSENING), pictures, run, resume=True)
    assert best.model_images == worsening[1].model_images
    assert_model_is_of(run, "best")


@pytest.mark.parametrize("change", ["images=64", "learning_rate=5e-5"])
def test_a_finished_run_stays_as_it_is_where_a_change_would_train_nothing(change, worsening, pictures):
    folder = worsening[0]
    before = {file: file.read_bytes() for file in folder.rglob("*") if file.is_file()}
    with pytest.raises(
        ValueError, match=rf"seen 96 images .*another \w*\.?{change.partition('=')[0]} .*raise images"
    ):
        train(resolve("small", [*WORSENING, change]), pictures, folder, resume=True)
    assert before == {file: file.read_bytes() for file in folder.rglob("*") if file.is_file()}


def test_a_resumed_run_whose_best_checkpoint_is_damaged_leaves_the_model_alone(worsening, pictures, tmp_path):
    run = Path(shutil.copytree(worsening[0], tmp_path / "run"))
    before = model_of(run)
    (run / "checkpoints" / "best" / WEIGHTS_FILE).write_bytes(b"cut off")
    with pytest.warns(DamageNoticed, match="best is damaged or missing: .*model stays as it is"):
        assert train(resolve("small", WORSENING), pictures, run, resume=True).model_images is None
    assert all(torch.equal(before[name], value) for name, value in model_of(run).items())


def test_a_run_without_held_out_pictures_keeps_its_last_weights(pictures, tmp_path):
    config = resolve("small", [*WORSENING, "split=[1,0,0]", "images=48"])
    assert train(config, pictures, tmp_path / "run").model_images == 48
    assert_model_is_of(tmp_path / "run", "last")


def test_resuming_nothing_or_with_other_settings_is_refused(pictures, tmp_path):
    config = resolve("small", [*TINY, "images=32"])
    with pytest.raises(FileNotFoundError, match="no run to resume"):
        train(config, pictures, tmp_path / "run", resume=True)
    train(config, pictures, tmp_path / "run")
    with pytest.raises(ValueError, match="trained with another seed"):
        train(resolve("small", [*TINY, "images=64", "seed=4"]), pictures, tmp_path / "run", resume=True)


def test_what_cannot_be_trained_is_refused_before_a_folder_is_made(pictures, tmp_path):
    with pytest.raises(ValueError, match="only one image was found"):
        train(resolve("small", TINY), pictures.select([0]), tmp_path / "run")
    with pytest.raises(ValueError, match="64 is more than the 48 training images: set batch_size=24"):
        train(resolve("small", [*TINY, "batch_size=64"]), pictures, tmp_path / "run")
    config = resolve("small", [*TINY, "perceptual=vgg16", f"vgg16_path={tmp_path / 'none.npz'}"])
    with pytest.raises((ValueError, OSError), match=r"none\.npz"):
        train(config, pictures, tmp_path / "run")
    assert not (tmp_path / "run").exists()


def kept_at(interval: int, images: int, step: int = 16) -> list[int]:
    """Where a state is kept, found step by step."""
    stops = range(step, images + 1, step)
    return [now for now in stops if kept(now - step, now, interval, ended=now == images)]


def test_states_are_kept_early_however_long_the_interval_is():
    assert kept_at(20_000, 60_000) == [320, 640, 1_264, 2_512, 5_008, 10_000, 20_000, 40_000, 60_000]
    assert kept_at(1_000, 3_200, step=100) == [500, 1_000, 2_000, 3_000, 3_200]
    assert kept_at(32, 96) == [32, 64, 96]
