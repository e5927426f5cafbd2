"""A plan from file to tables: what it leaves, kill -9 in the middle, jobs that fail."""

import json
import os
import signal
from pathlib import Path

import pytest
import torch
from filelock import FileLock
from tests.cli.conftest import coloured_people
from tests.trust.apart import start, waited

from derender.cli import main
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
  people: {data: PEOPLE, trained_on: colours, label: class, protocols: [cluster, linear]}
counts: [8]
draws: 1
untrained_seeds: 1
resamples: 10
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


def scores(out: Path) -> dict:
    """Every score of the clustering table."""
    told = json.loads((out / "comparison.json").read_text())
    return {one["name"]: one["rows"] for one in told["questions"] if one["protocol"] == "cluster"}


def test_one_table_with_controls_and_what_failed(whole):
    told = json.loads((whole / "comparison.json").read_text())
    question = told["questions"][0]
    controls = ["untrained encoder", "PCA (10)", "pixels", "majority", "chance"]
    assert list(question["rows"]) == ["ae", "hog", *controls]
    assert question["rows"]["pixels"]["scores"]["accuracy"]["value"] == 1
    (failed,) = told["failed"]
    assert failed.startswith("embed gone of people: no baseline at")
    text = (whole / "comparison.md").read_text()
    assert "| gone | failed | failed |" in text and failed in text and "*majority*" in text
    assert "people: Ward" in text and "people: above the strongest control?" in text
    page = (whole / "comparison.html").read_text()
    assert failed.partition("'")[0] in page and page.count("<svg") > 2 and "One training seed each" in page


def test_few_labels_show_one_head_and_the_tables_of_all(whole):
    summary, _, tables = (whole / "comparison.md").read_text().partition("people: 8 labelled rows")
    assert "| features | people, 8 labels: balanced ↑ |" in summary and "| gone | failed |" in summary
    assert "k-NN" not in summary and "k-NN" in tables and "penalised logistic regression" in tables


def test_the_same_command_again_does_nothing_twice(plan, whole, capsys):
    before, weights = scores(whole), whole / "runs" / "colours" / "ae" / "model" / "model.safetensors"
    at = weights.stat().st_mtime_ns
    words = ["compare", "--plan", str(plan), "--out", str(whole), "--workers", "2", "--minutes", "9"]
    assert main(words) == 0
    printed = capsys.readouterr().err
    assert "embed gone of people: failed" in printed  # tried again: it may have come
    assert "train ae" not in printed and "score people" not in printed
    assert scores(whole) == before and weights.stat().st_mtime_ns == at


def test_jobs_whose_inputs_changed_are_done_again(plan, whole, numbers, tmp_path):
    changed = tmp_path / "changed.yaml"
    for old, new, again in (
        ("resamples: 10", "resamples: 11", ["score people"]),
        ("code_size: 8", "code_size: 4", ["train ae on colours", "embed ae of people", "score people"]),
        (
            "untrained_seeds",
            "seeds: 2\nuntrained_seeds",
            ["train ae on colours, seed 1", "embed ae of people, seed 1"],
        ),
    ):
        changed.write_text(plan.read_text().replace(old, new).replace("  gone: {kind: ae", "  # {"))
        told, _ = numbers("compare", "--plan", changed, "--out", whole, "--dry-run")
        todo = [job for job, state in told["jobs"].items() if state == "to do"]
        assert set(again) <= set(todo) and ("embed hog of people" not in todo), (old, todo)


@pytest.mark.filterwarnings("ignore:.*fork:DeprecationWarning")  # while threads run
def test_killed_in_the_middle_it_ends_with_the_very_table(plan, whole, tmp_path, monkeypatch):
    def killed(run: loop._Run) -> None:
        kept(run)
        if run.state.images == 32:
            os.kill(os.getpid(), signal.SIGKILL)

    kept, out = loop._Run.checkpoint, plan.parent / "killed"
    out.mkdir()
    (out / ".plan.yaml-left").write_text("")  # by a kill at the very beginning
    words = ["compare", "--plan", str(plan), "--out", str(out)]
    with monkeypatch.context() as patch:
        patch.setattr(loop._Run, "checkpoint", killed)
        child = start(lambda: torch.set_num_threads(1) or main(words), tmp_path / "log")
    assert waited(child, 250) == -signal.SIGKILL
    assert (out / "runs" / "colours" / "ae" / "checkpoints" / "last").is_dir()
    assert not (out / "comparison.json").exists()
    assert main(words) == 0
    assert scores(out) == scores(whole)


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
    assert "go with --plan FILE" in refused("compare", "--table", "identity", "--dry-run")
    assert "give --table NAME" in refused("compare")
    assert "no plan at" in refused("compare", "--plan", tmp_path / "none.yaml", "--out", tmp_path / "o")
