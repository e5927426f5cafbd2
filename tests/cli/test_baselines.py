"""Baselines on the command line: train, embed, score, and ways to get it wrong."""

import json
from pathlib import Path

import pytest
from PIL import Image
from tests.cli.conftest import noise, settings
from tests.cli.conftest import run as call

from derender import FeatureTable

SETTINGS = settings("image_size=32", "width=8", "codes=8", "batch_size=4", "images=8")


@pytest.fixture(scope="module")
def faces(tmp_path_factory) -> Path:
    """24 images in the folders of two classes."""
    folder = tmp_path_factory.mktemp("cli") / "faces"
    noise(folder / "happy", 12)
    noise(folder / "sad", 12, cells=5)
    return folder


@pytest.fixture(scope="module")
def run(faces: Path, tmp_path_factory) -> Path:
    """A run folder of a VQ-VAE trained for two steps."""
    folder = tmp_path_factory.mktemp("cli") / "vqvae"
    assert call("train", "--model", "vqvae", "--data", faces, "--out", folder, *SETTINGS) == 0
    return folder


def test_a_run_has_a_report_and_goes_on(run, faces, capsys):
    assert "Baseline vqvae" in (run / "report.html").read_text()
    assert (run / "model" / "model.safetensors").is_file() and list((run / "samples").glob("*.png"))
    assert call("train", "--data", faces, "--out", run, "--resume") == 0
    assert "8 images in" in capsys.readouterr().err


def test_embed_then_cluster_as_with_our_own(run, faces, tmp_path, capsys):
    table_file, numbers = tmp_path / "vqvae.parquet", tmp_path / "numbers.json"
    embed = ["embed", "--baseline", "vqvae", "-m", run, "-d", faces, "--features", "pooled,histogram"]
    assert call(*embed, "--out", table_file, "--json", numbers) == 0
    table = FeatureTable.read(table_file)
    assert {name: values.shape[1] for name, values in table.factors.items()} == {"pooled": 8, "histogram": 8}
    assert table.origin["baseline"] == "vqvae" and table.origin["source"] == str(run)
    assert json.loads(numbers.read_text())["factors"] == {"pooled": 8, "histogram": 8}
    cluster = ["evaluate", "cluster", "--features", table_file, "--label", "class", "--factors", "pooled"]
    assert call(*cluster) == 0
    assert "pooled" in capsys.readouterr().out
    assert call(*cluster, "--data", faces, "--resamples", 2) == 0
    shown = capsys.readouterr().out
    assert "pixels" in shown and "PCA (6)" in shown
    assert "untrained" not in shown  # what is not known: an untrained encoder like a VQ-VAE's
    at_once = ["evaluate", "linear", "--model", run, "--data", faces, "--label", "class", "--counts", 4]
    at_once += ["--finetune", "--epochs", 1, "--seeds", 1, "--heads", "linear", "--resamples", 2]
    assert call(*at_once) == 0
    assert "fine-tuned" in capsys.readouterr().out


@pytest.mark.parametrize(("name", "size"), [("pixels", 3072), ("pca", 4), ("hog", 324), ("noise", 4)])
def test_controls_need_no_model(name, size, faces, run, tmp_path):
    out = tmp_path / "table.parquet"
    embed = ["embed", "--baseline", name, "-d", faces, "--image-size", 32, "--components", 4, "--out", out]
    assert call(*embed) == 0
    table = FeatureTable.read(out)
    assert table.factors[name].shape == (24, size) and table.origin["control"] == name
    assert "class" in table.labels
    part = [*embed[:-1], tmp_path / "part.parquet", "--part", "test", "--model", run]
    assert call(*part) == 0
    test = FeatureTable.read(tmp_path / "part.parquet")
    assert len(test) == 2 and test.origin["part"] == "test" and "part" not in table.origin
    assert name != "pca" or test.origin["fitted_on"] == 19


def test_controls_keep_copies_where_asked_and_name_unreadable_files(tmp_path, capsys, refused):
    folder, out = tmp_path / "images", tmp_path / "table.parquet"
    folder.mkdir()
    for name, tone in {"a": 10, "b": 90, "c": 90}.items():
        Image.new("RGB", (32, 32), (tone, 0, 0)).save(folder / f"{name}.png")
    (folder / "bad.png").write_bytes(b"no image")
    embed = ["embed", "--baseline", "pixels", "-d", folder, "--out", out]
    assert call(*embed) == 0
    printed = capsys.readouterr().err
    assert "1 skipped, 1 identical copies dropped" in printed and "skipped bad.png: not an" in printed
    assert call(*embed, "--keep-duplicates", "--force") == 0
    assert len(FeatureTable.read(out)) == 3 and "1 identical copies kept" in capsys.readouterr().err
    assert "leave it out" in refused(*embed, "--force", "--engine", "ray")
    assert "--fit-steps belongs to our models" in refused(*embed, "--force", "--fit-steps", 2)


def test_resnet18_trains_on_labels_and_embeds(faces, tmp_path, refused):
    run, out = tmp_path / "resnet18", tmp_path / "table.parquet"
    train = ["train", "--model", "resnet18", "--data", faces, "--out", run]
    few = ("labels=class", "labelled=8", "epochs=1", "batch_size=4", "image_size=32", "width=4")
    assert "name a label to learn" in refused(*train)
    train += settings(*few)
    assert call(*train) == 0
    assert "is not resumed" in refused(*train, "--resume")
    embed = ["embed", "--baseline", "resnet18", "--model", run, "--data", faces, "--out", out]
    assert call(*embed) == 0
    assert FeatureTable.read(out).factors["pooled"].shape == (24, 32)


def test_bad_words_are_one_line(run, faces, tmp_path, refused):
    out = tmp_path / "t.parquet"
    embed = ("embed", "--data", faces, "--out", out)
    assert "did you mean 'vqvae'" in refused(*embed, "--baseline", "vqvea")
    assert "give --model RUN, or --baseline NAME" in refused(*embed)
    for name in ("vqvae", "untrained"):
        assert f"the baseline {name} needs a model" in refused(*embed, "--baseline", name)
    maps = ("--baseline", "vqvae", "--model", run, "--features", "maps")
    assert "unknown feature of vqvae 'maps'; did you mean 'map'" in refused(*embed, *maps)
    assert "holds the baseline 'vqvae'" in refused(*embed, "--model", run)
    assert "holds the baseline 'vqvae', asked for ae" in refused(*embed, "--baseline", "ae", "--model", run)
    assert "hf download" in refused(*embed, "--baseline", "dinov2", "--model", "nobody/nothing")
    assert "needs a model" in refused(*embed, "--baseline", "pixels", "--part", "test")
    assert "(N, 3" not in refused(*embed, "--baseline", "pca", "--image-size", "16")
    train = ("train", "--data", faces, "--out", tmp_path / "run")
    assert "did you mean 'simclr'" in refused(*train, "--model", "simcrl")
    assert "preset is for derender models" in refused(*train, "--model", "ae", "--preset", "small")
    assert "'model.codes'" in refused(*train, "--model", "vqvae", "--set", "codess=3")
    other = refused("train", "--model", "ae", "--data", faces, "--out", run, "--resume")
    assert f"{run} trained vqvae, not ae" in other
    other = refused("train", "--data", faces, "--out", run, "--resume", *SETTINGS, *settings("seed=9"))
    assert f"{run} was trained with another seed" in other
    assert not out.exists() and not (tmp_path / "run").exists()
