"""A factor and a renderer in a user's own file: trained, embedded, scored, decomposed, swapped and relit."""

import importlib
import json
import sys
from pathlib import Path

import pytest
from tests.cli.conftest import run

import derender
from derender.learn import whiten

EXAMPLES = Path(__file__).resolve().parents[2] / "examples"


@pytest.fixture
def made(tmp_path, monkeypatch, capsys):
    monkeypatch.syspath_prepend(str(EXAMPLES))
    arguments = ["--out", str(tmp_path), "--count", "24", "--images", "16", "--size", "32"]
    monkeypatch.setattr(sys, "argv", ["05_new_factor.py", *arguments])
    importlib.import_module("05_new_factor").main()
    return tmp_path, capsys.readouterr().out


def test_the_example_goes_through_every_command(made):
    folder, printed = made
    assert "'white': (24, 256)" in printed and "Swap test" in printed
    model = derender.load(folder / "run")
    assert model.renderer.name == "05_new_factor:BALANCE" and model.factors[-1].name == "white"
    image, other = sorted((folder / "data" / "images").iterdir())[:2]
    source = ("--model", folder / "run", "--size", 32)
    assert run("decompose", *source, image, "--out", folder / "d") == 0
    scene = json.loads((folder / "d" / image.stem / "scene.json").read_text())
    assert set(scene["white"]) == {"red", "blue"} and 0.7 <= scene["white"]["red"] <= 1.4
    assert run("swap", *source, image, "--from", other, "--out", folder / "s") == 0
    moved = json.loads((folder / "s" / image.stem / "moved.json").read_text())
    assert "its white" in [still["label"] for still in moved["stills"]]
    still = ("--film", "none", "--stills", "2")
    assert run("relight", *source, image, "--like", other, "--out", folder / "r", *still) == 0
    few = {"whitening.pictures": 8, "whitening.spatial": False, "examples": 8}
    copy = whiten(model, folder / "data", out=folder / "w", settings=few)
    assert "white" in copy.scores["between_over_within"]
    with pytest.raises(ValueError, match="made with the renderer '05_new_factor:BALANCE', not 'lambert'"):
        derender.load(folder / "run", renderer="lambert")
