"""A plan from file to tables: what it leaves, kill -9 in the middle, the end of the budget, workers."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from filelock import FileLock
from PIL import Image
from tests.cli.conftest import coloured_people

from derender.cli import main
from derender.learn.jobs import Comparison, jobs_of, run_progress
from derender.learn.plan import read_plan
from derender.learn.sweep import in_own_process
from derender.training import loop

PLAN = """
images: 64
image_size: 32
settings: {batch_size: 16, checkpoint_every: 16, validate_every: 64, watch: true}
train:
  colours: {data: PEOPLE}
methods:
  ae: {settings: {image_size: 32, width: 4, code_size: 8}}
  hog:
  gone: {kind: ae, runs: {colours: PEOPLE/none}}
score:
  people: {data: PEOPLE, trained_on: colours, label: class}
untrained_seeds: 1
resamples: 10
"""
KILLED = """
import os, signal, sys
from derender.cli import main
from derender.training import loop

kept = loop._Run.checkpoint

def killed(run):
    kept(run)
    if run.state.images == 32:
        os.kill(os.getpid(), signal.SIGKILL)

loop._Run.checkpoint = killed
main(sys.argv[1:])
"""


@pytest.fixture(scope="module")
def plan(tmp_path_factory) -> Path:
    """Forty images of four made-up people, distinguished by their colour, and a plan that scores them."""
    folder = tmp_path_factory.mktemp("plan")
    coloured_people(folder / "people", 40, 32)
    (folder / "plan.yaml").write_text(PLAN.replace("PEOPLE", str(folder / "people")))
    return folder / "plan.yaml"


@pytest.fixture(scope="module")
def whole(plan) -> Path:
    """The plan's folder after one uninterrupted call."""
    assert main(["compare", "--plan", str(plan), "--out", str(plan.parent / "whole")]) == 0
    return plan.parent / "whole"


def killing(*_: object, **__: object) -> None:
    """A progress bar that ends its process."""
    os.kill(os.getpid(), signal.SIGKILL)


def scores(out: Path) -> dict:
    """Every score of the clustering table."""
    told = json.loads((out / "clustering.json").read_text())
    return {one["name"]: one["rows"] for one in told["questions"]}


def test_one_table_and_one_picture_with_controls_costs_and_what_failed(whole):
    told = json.loads((whole / "clustering.json").read_text())
    (question,) = told["questions"]
    controls = ["untrained encoder", "PCA (10)", "pixels", "majority", "chance"]
    assert list(question["rows"]) == ["ae", "hog", *controls]
    assert question["rows"]["pixels"]["scores"]["accuracy"]["value"] == 1
    cost = question["costs"]["ae"]
    assert (cost["images"], cost["numbers"]) == (64, 8)
    assert cost["seconds"] > 0 and cost["parameters"] > 1_000
    assert question["costs"]["untrained encoder"]["parameters"] > cost["parameters"]
    assert question["absent"]["gone"].startswith("failed: no baseline at") and "gone" in told["failed"][0]
    text = (whole / "clustering.md").read_text()
    assert "| gone | failed | - |" in text and "Failed or missing" in text and "*majority*" in text
    assert (whole / "clustering.tex").read_text().count(r"\begin{table}") == 3
    page = (whole / "clustering.html").read_text()
    assert page.count("<svg") == 2 and "One training seed each" in page
    assert (whole / "clustering.svg").read_text().startswith("<svg")
    with Image.open(whole / "clustering.png") as picture:
        assert picture.size[0] > 500


def test_the_same_command_again_does_nothing_twice(plan, whole, capsys):
    before, weights = scores(whole), whole / "runs" / "colours" / "ae" / "model" / "model.safetensors"
    at = weights.stat().st_mtime_ns
    assert main(["compare", "--plan", str(plan), "--out", str(whole)]) == 0
    printed = capsys.readouterr().err
    assert "train gone on colours: failed" in printed  # tried again: it may have come
    assert "train ae" not in printed and "score people" not in printed
    assert scores(whole) == before and weights.stat().st_mtime_ns == at


def test_killed_in_the_middle_it_ends_with_the_very_table(plan, whole):
    out = plan.parent / "killed"
    out.mkdir()
    (out / ".plan.yaml-left").write_text("")  # by a kill at the very beginning
    words = ["compare", "--plan", str(plan), "--out", str(out)]
    done = subprocess.run([sys.executable, "-c", KILLED, *words], capture_output=True, timeout=250)
    assert done.returncode == -signal.SIGKILL
    assert run_progress(out / "runs" / "colours" / "ae")["images"] == 32
    assert not (out / "clustering.json").exists()
    assert main(words) == 0
    assert scores(out) == scores(whole)


def test_the_budget_ends_a_training_and_leaves_tables(plan, whole, monkeypatch, capsys):
    out = plan.parent / "budget"
    words = ["compare", "--plan", str(plan), "--out", str(out)]
    now, step = [0.0], loop._Run.step

    def slow_step(run: loop._Run) -> object:
        now[0] += 60
        return step(run)

    with monkeypatch.context() as patch:  # every step takes a minute
        patch.setattr(loop._Run, "step", slow_step)
        patch.setattr(time, "time", lambda: now[0])
        assert main([*words, "--minutes", "1.5"]) == 0
    printed = capsys.readouterr().err
    assert "the budget is used; the same command continues where it stopped" in printed
    assert run_progress(out / "runs" / "colours" / "ae")["images"] == 32
    assert "missing: train ae on colours: the budget was used before it was done (32 of 64" in printed
    told = json.loads((out / "clustering.json").read_text())
    assert "ae" not in told["questions"][0]["rows"] and "pixels" in told["questions"][0]["rows"]
    assert told["questions"][0]["absent"]["ae"].startswith("missing: ")
    assert main(words) == 0
    assert scores(out) == scores(whole)


def test_worker_processes_do_the_same(plan, whole):
    few = plan.parent / "few.yaml"
    text = plan.read_text()
    few.write_text(text[: text.index("  ae:")] + "  hog:\n" + text[text.index("score:") :])
    out = plan.parent / "workers"
    assert main(["compare", "--plan", str(few), "--out", str(out), "--workers", "2"]) == 0
    assert scores(out)["people"]["hog"]["scores"] == scores(whole)["people"]["hog"]["scores"]


def test_a_worker_that_was_killed_costs_itself_alone(plan, tmp_path):
    at = Comparison(read_plan(plan), tmp_path, bar=killing)
    job = jobs_of(at.plan)[0]
    note = in_own_process(at, job)
    assert note.state == "failed" and "its process was killed" in note.why and at.note(job) == note


def test_two_at_once_in_one_folder_are_refused(plan, tmp_path, refused):
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "plan.yaml").write_text("")
    with FileLock(tmp_path / "out" / ".lock"):
        told = refused("compare", "--plan", plan, "--out", tmp_path / "out")
    assert "another derender compare works in" in told


def test_what_does_not_go_together_is_one_line(plan, tmp_path, refused):
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "letter.txt").write_text("mine")
    by_plan = ("compare", "--plan", plan)
    assert "holds no comparison" in refused(*by_plan, "--out", tmp_path / "mine")
    assert [file.name for file in (tmp_path / "mine").iterdir()] == ["letter.txt"]
    assert "is a file" in refused(*by_plan, "--out", plan)
    assert "--plan needs --out" in refused(*by_plan)
    assert "beside --plan go --out" in refused(*by_plan, "--table", "identity")
    assert "beside --plan go --out" in refused(*by_plan, "--seeds", "2")
    assert "go with --plan FILE" in refused("compare", "--table", "identity", "--workers", "2")
    assert "give --table NAME" in refused("compare")
    assert "no plan at" in refused("compare", "--plan", tmp_path / "none.yaml", "--out", tmp_path / "o")
