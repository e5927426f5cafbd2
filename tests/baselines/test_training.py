"""Baselines through the training loop: what a run leaves, exact resume, files that are not what they say."""

import json
import pickle
import shutil

import numpy as np
import pytest
import torch
from PIL import Image
from safetensors.torch import load_file, save_file

import derender
from derender.baselines import baseline_config, load_baseline, network_type, read_any_config
from derender.baselines.model import BaselineTask
from derender.features import embed_pictures
from derender.report.run import baseline_sheet, run_page
from derender.training import resolve, train
from derender.training.checkpoint import WEIGHTS_FILE
from derender.training.config import config_from_tree
from derender.training.loop import train_task
from derender.training.run_folder import read_config, read_metrics
from derender.training.task import StepLosses
from derender.training.watch import FiniteWatch

COMMON = ["image_size=32", "width=8", "batch_size=8", "checkpoint_every=24", "validate_every=24"]
COMMON += ["sample_every=48", "deterministic=true"]
OWN = {"vqvae": ["codes=8"], "simclr": ["code_size=16"], "ae": ["code_size=16"], "beta-vae": ["code_size=16"]}


def task(name: str, images: int, *more: str) -> BaselineTask:
    return BaselineTask(baseline_config(name, [*COMMON, *OWN[name], f"images={images}", *more]))


@pytest.fixture(scope="module")
def runs(blobs, tmp_path_factory):
    """One finished run of each, by name; generators have their own tests in stylegan2/."""
    folder = tmp_path_factory.mktemp("runs")
    for name in OWN:
        one = task(name, 48)
        train_task(one, blobs, folder / name, sample_sheet=baseline_sheet(one.shown))
    torch.use_deterministic_algorithms(False)
    return folder


def weights(run) -> dict[str, torch.Tensor]:
    return load_file(run / "checkpoints" / "last" / WEIGHTS_FILE)


@pytest.mark.parametrize("name", OWN)
def test_a_run_leaves_what_ours_leave_and_makes_a_table(name, runs, blobs, tmp_path):
    run = runs / name
    assert read_any_config(run) == task(name, 48).config
    assert {path.name for path in (run / "checkpoints").iterdir()} == {"last", "previous", "best"}
    assert [row["kind"] for row in read_metrics(run)] == ["train", "validation", "validation"]
    with Image.open(run / "samples" / "000000048.png") as sheet:
        columns = 5 if name == "simclr" else 2
        assert sheet.width > columns * 160 and np.asarray(sheet).std() > 20
    assert f"Baseline {name}, seed 0." in run_page(run).html()

    model = load_baseline(run)
    table = embed_pictures(model, blobs, batch_size=7, origin={"baseline": name})
    assert set(table.factors) == {model.features[0]} and table.origin["baseline"] == name
    again = embed_pictures(load_baseline(run / "model", name), blobs, batch_size=48)
    for factor, values in table.factors.items():
        np.testing.assert_allclose(values, again.factors[factor], rtol=1e-3, atol=1e-4)
    best = load_file(run / "checkpoints" / "best" / WEIGHTS_FILE)
    assert all(torch.equal(value, best[key]) for key, value in model.state_dict().items())


@pytest.mark.parametrize("name", OWN)
def test_a_resumed_run_ends_with_the_very_weights_of_an_undisturbed_one(name, runs, blobs, tmp_path):
    train_task(task(name, 24), blobs, tmp_path / "parts")
    train_task(task(name, 48), blobs, tmp_path / "parts", resume=True)
    whole, parts = weights(runs / name), weights(tmp_path / "parts")
    assert whole.keys() == parts.keys()
    assert all(torch.equal(whole[key], parts[key]) for key in whole)
    with pytest.raises(ValueError, match="was trained with another seed"):
        train_task(task(name, 72, "seed=3"), blobs, tmp_path / "parts", resume=True)


def test_physical_views_train_and_the_renderer_stays_out_of_the_checkpoint(blobs, tmp_path):
    ours = derender.Derenderer.from_preset("small", seed=0, image_size=32, width=8, light_width=4)
    physics = ours.save(tmp_path / "ours")
    one = task("simclr", 16, "views=physical", f"physics={physics}")
    train_task(one, blobs, tmp_path / "run", sample_sheet=baseline_sheet(one.shown))
    plain = {"encoder", "head"}
    assert {key.split(".")[0] for key in weights(tmp_path / "run")} == plain
    with pytest.raises(ValueError, match="views=physical and physics=RUN"):
        baseline_config("simclr", ["views=physical"])
    with pytest.raises(FileNotFoundError, match="no model at"):
        train_task(task("simclr", 16, "views=physical", "physics=nowhere"), blobs, tmp_path / "no")
    assert not (tmp_path / "no").exists()


def test_a_loss_that_is_no_number_stops_the_run(blobs, tmp_path):
    watch = FiniteWatch()
    assert watch.look(8, StepLosses(torch.tensor(1.0), {})) == ()
    (finding,) = watch.look(8, StepLosses(torch.tensor(float("nan")), {}))
    assert finding.fatal and "nan" in finding.text
    result = train_task(task("ae", 480, "learning_rate=1e30"), blobs, tmp_path / "run")
    assert result.stopped == "collapse" and result.images < 480


def test_another_architecture_names_the_first_key_that_differs(runs, tmp_path):
    """Resuming, and loading: a key that is missing, that is new, or that has another shape."""
    for change, message in [
        ({"width": 12}, r"another architecture: 'encoder\.convolutions\.0\.weight' has shape \(8, 3, 4, 4\)"),
        ({"image_size": 64}, "another architecture: "),
    ]:
        copy = tmp_path / next(iter(change))
        shutil.copytree(runs / "ae" / "model", copy)
        config = json.loads((copy / "config.json").read_text())
        config["settings"].update(change)
        (copy / "config.json").write_text(json.dumps(config))
        with pytest.raises(ValueError, match=message):
            load_baseline(copy)
    for change, message in [
        (lambda stored: stored.pop("decoder.last.weight"), r"it has no 'decoder\.last\.weight', which"),
        (lambda stored: stored.update(stranger=torch.zeros(2)), "it has 'stranger', which this architecture"),
    ]:
        copy = tmp_path / message[:9]
        shutil.copytree(runs / "ae" / "model", copy)
        stored = load_file(copy / "model.safetensors")
        change(stored)
        save_file(stored, copy / "model.safetensors")
        with pytest.raises(ValueError, match=message):
            load_baseline(copy)


def test_a_checkpoint_of_another_architecture_names_the_key(runs, blobs, tmp_path):
    run = tmp_path / "run"
    shutil.copytree(runs / "ae", run)
    shutil.rmtree(run / "checkpoints" / "last")
    shutil.copytree(runs / "simclr" / "checkpoints" / "last", run / "checkpoints" / "last")
    with pytest.raises(ValueError, match=r"of another model \(it has no 'decoder\.layers\.0\.weight'"):
        train_task(task("ae", 72), blobs, run, resume=True)


def test_damaged_and_foreign_folders_are_named(runs, tmp_path):
    copy = tmp_path / "copy"
    shutil.copytree(runs / "ae" / "model", copy)
    file = copy / "model.safetensors"
    file.write_bytes(file.read_bytes()[:-50])
    with pytest.raises(ValueError, match=r"model\.safetensors is damaged"):
        load_baseline(copy)
    (copy / "config.json").write_text("{")
    with pytest.raises(ValueError, match=r"config\.json is damaged"):
        load_baseline(copy)
    (copy / "config.json").write_text(json.dumps({"format": 99, "baseline": "ae", "settings": {}}))
    with pytest.raises(ValueError, match="saved in format 99"):
        load_baseline(copy)
    (copy / "config.json").write_text(
        json.dumps({"format": 1, "baseline": "ae", "settings": {"width": "wide"}})
    )
    with pytest.raises(ValueError, match="setting 'width'"):
        load_baseline(copy)
    with pytest.raises(ValueError, match="holds the baseline 'ae', asked for vqvae"):
        load_baseline(runs / "ae", "vqvae")
    with pytest.raises(FileNotFoundError, match="no baseline at"):
        load_baseline(tmp_path / "nowhere")
    with pytest.raises(ValueError, match=r"holds the baseline 'ae'.*--baseline ae"):
        derender.load(runs / "ae")


def test_a_pickle_is_refused_and_never_opened(tmp_path):
    """Its code would make a file."""

    class Trap:
        def __reduce__(self):
            return (open, (str(tmp_path / "sprung"), "w"))

    folder = tmp_path / "folder"
    folder.mkdir()
    for file in (tmp_path / "weights.pth", folder / "pytorch_model.bin"):
        file.write_bytes(pickle.dumps(Trap()))
    with pytest.raises(ValueError, match=r"weights\.pth is a pickle, which can run code"):
        load_baseline(tmp_path / "weights.pth")
    with pytest.raises(ValueError, match=r"pytorch_model\.bin is a pickle"):
        load_baseline(folder)
    (folder / "config.json").write_text(json.dumps({"format": 1, "baseline": "ae", "settings": {}}))
    shutil.copy(tmp_path / "weights.pth", folder / "model.safetensors")
    with pytest.raises(ValueError, match=r"model\.safetensors is damaged"):
        load_baseline(folder)
    assert not (tmp_path / "sprung").exists()


def test_a_run_of_one_kind_is_not_taken_for_another(runs, blobs, tmp_path):
    with pytest.raises(ValueError, match="is a run of the baseline ae, not of a derender model"):
        read_config(runs / "ae")
    with pytest.raises(ValueError, match="is a run of the baseline ae, not of the baseline vqvae"):
        read_config(runs / "ae", network_type("vqvae").config_type)
    with pytest.raises(ValueError, match="is a run of the baseline ae, not of a derender model"):
        train(resolve("small", ["image_size=32", "perceptual=none"]), blobs, runs / "ae", resume=True)
    with pytest.raises(ValueError, match=r"unknown setting 'model\.widht'; did you mean 'model\.width'"):
        tree = network_type("vqvae").config_type().model_dump(mode="json")
        config_from_tree({**tree, "model": {**tree["model"], "widht": 3}}, network_type("vqvae").config_type)
