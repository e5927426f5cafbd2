"""Joint training on the command line: from a run and from nothing, resumed, scored, and got wrong."""

import json
import shutil

import yaml
from PIL import Image
from tests.cli.conftest import TINY, run, settings

from derender import FeatureTable
from derender.inputs import split_of

STEPS = ["images=16", "batch_size=8"]


def test_from_a_run_to_features_and_scores(trained, faces, tmp_path, capsys, refused):
    out, numbers = tmp_path / "tuned", tmp_path / "numbers.json"
    words = ["finetune", "-m", trained, "-d", faces, "--label", "expression", "--out", out]
    split = settings("images=16", "split=[0.6, 0.2, 0.2]")
    words += ["--labelled", 20, "--weight", 2, *split, "--json", numbers]
    text, typeset, page = (tmp_path / f"scores.{form}" for form in ("md", "tex", "html"))
    words += ["--markdown", text, "--latex", typeset, "--cache", tmp_path / "cache"]
    assert run(*words, "--html", page) == 0
    shown = capsys.readouterr()
    assert "20 labelled images learned, 8 held out" in " ".join(shown.out.split())
    assert "the strongest control (" in shown.err
    told = json.loads(numbers.read_text())["scores"]
    frozen = ["frozen, logistic", "frozen, paper's head"]
    controls = ["untrained encoder, logistic", "PCA (6), logistic", "pixels, logistic", "majority"]
    assert list(told["rows"]) == ["fine-tuned", *frozen, *controls]
    assert "| *pixels, logistic* |" in text.read_text()
    assert r"\textit{frozen, paper's head}" in typeset.read_text()
    assert "<table" in page.read_text()
    assert told["kind"] == "classes" and told["n_train"] == 20
    config = yaml.safe_load((out / "config.yaml").read_text())
    assert config["start"] == str(trained) and config["target"]["weight"] == 2
    assert config["batch_size"] == 4 and config["model"]["network"]["width"] == 4
    assert (out / "report.html").is_file()
    table = tmp_path / "t.parquet"
    assert run("embed", "-m", out, "-d", faces, "--part", "test", "--out", table) == 0
    tested = FeatureTable.read(table)
    assert tested.factors["geometry"].shape == (8, 256) and tested.origin["part"] == "test"
    again = ["finetune", "-d", faces, "--out", out, "--resume", "--cache", tmp_path / "cache"]
    capsys.readouterr()
    assert run(*again, "--json", "-") == 0
    shown = capsys.readouterr()
    assert "16 images in" in shown.err and "0 results computed, 9 found" in shown.err
    assert json.loads(shown.out)["scores"] == told
    assert run(*words, "--resume", "--force") == 0
    resume = ("-d", faces, "--resume", "--out")
    assert split_of(out / "model") == split_of(out) is not None, "as models of derender train do"
    assert refused("finetune", *resume, out, "--weight", 3).endswith("leave out weight")
    other = (*words[1:], "--resume", "--force", "--factors", "albedo", "--set", "seed=1")
    assert refused("finetune", *other).endswith(": leave out factors, seed=1")
    assert refused("finetune", *resume, out, "--rendering-weight", 0).endswith("leave out rendering_weight")
    moved = shutil.copytree(faces, tmp_path / "moved")
    for file in (moved / "images").iterdir():
        Image.eval(Image.open(file), lambda level: 255 - level).save(file)
    assert "not on these 40" in refused("finetune", "-d", moved, *resume[2:], out)
    assert "continue with derender finetune --resume" in refused("train", *resume, out)
    assert "continue with derender train --resume" in refused("finetune", *resume, trained)


def test_from_fresh_weights_by_labels_alone(faces, tmp_path, capsys):
    words = ["finetune", "--preset", "small", "-d", faces, "--label", "expression", "--out", tmp_path / "run"]
    words += ["--rendering-weight", 0, "--factors", "albedo,light", "--cache", "none"]
    words += settings(*TINY, *STEPS)
    assert run(*words) == 0
    assert "frozen features of fresh weights" in " ".join(capsys.readouterr().out.split())
    assert run(*words, "--dry-run", "--json", "-") == 0
    assert json.loads(capsys.readouterr().out)["target"]["factors"] == ["albedo", "light"]


def test_bad_words_are_one_line(trained, faces, tmp_path, refused):
    tune = ("finetune", "-d", faces, "--out", tmp_path / "out")
    assert "give either labels or attributes" in refused(*tune)
    assert "give either labels or attributes" in refused(*tune, "-l", "expression", "--attributes")
    assert "no yes/no label" in refused(*tune, "--attributes", "--preset", "small", *settings(*TINY))
    assert "give one of them" in refused(*tune, "-m", trained, "--preset", "small", "-l", "expression")
    from_run = (*tune, "-m", trained, "-l", "expression")
    assert "no label 'expresion'; did you mean 'expression'" in refused(*from_run[:-1], "expresion")
    assert "leave out settings of model.network" in refused(*from_run, *settings("model.network.width=8"))
    assert "target.weight" in refused(*from_run, "--weight", "-1")
    assert "no run to resume" in refused(*tune, "--resume")
    assert not (tmp_path / "out").exists()
    there = tmp_path / "there"
    there.mkdir()
    (there / "thesis.txt").write_text("mine")
    assert "is not empty" in refused(*tune[:3], "--out", there, "-l", "expression", "-m", trained)
