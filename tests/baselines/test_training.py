"""Baselines through the training loop: what a run leaves, exact resume, files that are not what they say."""

import json
import shutil
import sys

import numpy as np
import pytest
import torch
from PIL import Image
from safetensors.torch import load_file, save_file
from tests.baselines.conftest import OWN, config, generator_of
from tests.training.conftest import assert_same_weights, weights

import derender
from derender.baselines import load_baseline, network_type, read_any_config, train_baseline
from derender.features import embed_image_set
from derender.overrides import checked
from derender.report.run import run_page, sample_sheet
from derender.training import resolve, train
from derender.training.run_folder import read_config, read_metrics


@pytest.fixture
def copy(runs, tmp_path):
    """A saved model, to be changed."""
    return shutil.copytree(runs / "ae" / "model", tmp_path / "copy")


@pytest.mark.parametrize("name", OWN)
def test_a_run_leaves_what_ours_leave_makes_a_table_and_resumes_exactly(name, runs, blobs, tmp_path):
    run, generator = runs / name, generator_of(name, runs)
    assert read_any_config(run) == config(name, 48, *generator)
    assert {path.name for path in (run / "checkpoints").iterdir()} == {"last", "previous", "best"}
    assert [row["kind"] for row in read_metrics(run)] == ["train", "validation", "validation"]
    with Image.open(run / "samples" / "000000048.png") as sheet:
        columns = {"simclr": 5, "stylegan2": 7}.get(name, 2)
        assert sheet.width > columns * 160 and np.asarray(sheet).std() > 20
    assert f"Baseline {name}, seed 0." in run_page(run).html()

    model = load_baseline(run)
    table = embed_image_set(model, blobs, batch_size=7, origin={"baseline": name})
    assert set(table.factors) == {model.features[0]} and table.origin["baseline"] == name
    again = embed_image_set(load_baseline(run / "model", name), blobs, batch_size=48)
    for factor, values in table.factors.items():
        np.testing.assert_allclose(values, again.factors[factor], rtol=1e-3, atol=1e-4)
    best = weights(run, "best")
    assert all(torch.equal(value, best[key]) for key, value in model.state_dict().items())

    train_baseline(config(name, 24, *generator), blobs, tmp_path / "parts")
    train_baseline(config(name, 48, *generator), blobs, tmp_path / "parts", resume=True)
    assert_same_weights(run, tmp_path / "parts")
    with pytest.raises(ValueError, match="was trained with another seed"):
        train_baseline(config(name, 72, "seed=3", *generator), blobs, tmp_path / "parts", resume=True)


def test_physical_views_train_and_the_renderer_stays_out_of_the_checkpoint(blobs, tmp_path):
    ours = derender.Derenderer.from_preset("small", seed=0, image_size=32, width=8, light_width=4)
    own = config("simclr", 16, "views=physical", f"physics={ours.save(tmp_path / 'ours')}")
    train_baseline(own, blobs, tmp_path / "run", sample_sheet=sample_sheet)
    assert {key.split(".")[0] for key in weights(tmp_path / "run")} == {"encoder", "head"}
    with pytest.raises(FileNotFoundError, match="no model at"):
        train_baseline(config("simclr", 16, "views=physical", "physics=nowhere"), blobs, tmp_path / "no")
    assert not (tmp_path / "no").exists()


@pytest.mark.parametrize(
    ("settings", "change", "message"),
    [
        ({"width": 12}, {}, r"'encoder\.convolutions\.0\.weight' has shape \(8, 3, 4, 4\)"),
        ({"image_size": 64}, {}, ""),
        ({}, {"decoder.last.weight": None}, r"it has no 'decoder\.last\.weight', which this"),
        ({}, {"stranger": torch.zeros(2)}, "it has 'stranger', which this architecture"),
    ],
)
def test_weights_of_another_architecture_name_the_first_key_that_differs(settings, change, message, copy):
    tree = json.loads((copy / "config.json").read_text())
    (copy / "config.json").write_text(json.dumps({**tree, "settings": tree["settings"] | settings}))
    stored = load_file(copy / "model.safetensors") | change
    save_file({key: v for key, v in stored.items() if v is not None}, copy / "model.safetensors")
    with pytest.raises(ValueError, match=rf"is damaged \({message}.*copy or train"):
        load_baseline(copy)


def test_damaged_and_foreign_folders_are_named(runs, copy, tmp_path):
    file = copy / "model.safetensors"
    file.write_bytes(file.read_bytes()[:-50])
    with pytest.raises(ValueError, match=r"is damaged \(model\.safetensors is cut off"):
        load_baseline(copy)
    for text, message in (
        ("{", r"config\.json is damaged"),
        ('{"format": 1, "baseline": "ae"}', r"config\.json is damaged"),
        ('{"format": 99, "baseline": "ae", "settings": {}}', "saved in format 99"),
        ('{"format": 1, "settings": {}}', "holds a derender model and no baseline"),
        ('{"format": 1, "baseline": "ae", "settings": {"width": "wide"}}', r"damaged \(width: "),
    ):
        (copy / "config.json").write_text(text)
        with pytest.raises(ValueError, match=message):
            load_baseline(copy)
    with pytest.raises(ValueError, match="holds the baseline 'ae', asked for vqvae"):
        load_baseline(runs / "ae", "vqvae")
    with pytest.raises(FileNotFoundError, match="no baseline at"):
        load_baseline(tmp_path / "nowhere")
    with pytest.raises(ValueError, match=r"holds the baseline 'ae'.*--baseline ae"):
        derender.load(runs / "ae")


def test_a_missing_package_is_not_taken_for_damage(runs, monkeypatch):
    monkeypatch.setitem(sys.modules, "vector_quantize_pytorch", None)
    with pytest.raises(ValueError, match=r"^the baseline vqvae needs the package vector_quantize_pytorch"):
        load_baseline(runs / "vqvae")


def test_a_run_of_one_kind_is_not_taken_for_another(runs, blobs):
    vqvae, other = network_type("vqvae").config_type, "is a run of the baseline ae, not of "
    with pytest.raises(ValueError, match=other + "a derender model"):
        read_config(runs / "ae")
    with pytest.raises(ValueError, match=other + "the baseline vqvae"):
        read_config(runs / "ae", vqvae)
    with pytest.raises(ValueError, match=other + "a derender model"):
        train(resolve("small", ["image_size=32", "perceptual=none"]), blobs, runs / "ae", resume=True)
    tree = vqvae().model_dump(mode="json")
    with pytest.raises(ValueError, match=r"unknown setting 'model\.widht'; did you mean 'model\.width'"):
        checked({**tree, "model": {**tree["model"], "widht": 3}}, vqvae)
