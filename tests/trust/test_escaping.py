"""Names that are markup or formulas, in every kind of report: one script, the page's own, and no handler."""

import json
from types import SimpleNamespace

import numpy as np
import pytest
from PIL import Image
from tests.report.test_page import Elements

from derender.data import ImageSet, Skipped
from derender.data.doctor import doctor
from derender.evaluation.linear_task import Rows, task_of
from derender.evaluation.score_table import Column, Row, ScoreTable
from derender.interpretation import cluster_shares, explain_labels, explanation, pair_parts
from derender.report import charts
from derender.report.explanation import explanation_page
from derender.report.page import Page
from derender.report.protocols import comparison_page
from derender.report.run import doctor_page, run_page
from derender.training.config import resolve
from derender.training.run_folder import append_metrics, start_run

EVIL = ["<script>alert(1)</script>", "</script><img src=x onerror=alert(2)>", '" onload="alert(3)']
EVIL.append("$\\frac$ & ]]>")


def harmless(page: Page, evil: str) -> None:
    """Look for what a browser could run or fetch."""
    html = page.html()
    result = Elements(html).found
    assert [tag for tag, _ in result].count("script") == 1
    for tag, attributes in result:
        assert tag not in ("iframe", "object", "embed", "base", "form")
        assert not [name for name in attributes if name.startswith("on")], (tag, attributes)
        places = [attributes[name] or "" for name in ("src", "href") if name in attributes]
        assert all(place.startswith(("data:", "#")) for place in places)
    assert "<" not in evil or evil not in html  # quotes may stand in text, where they end nothing


def made_table(evil: str) -> ScoreTable:
    rows = [Row(evil, [0.5, evil], note=evil), Row(f"{evil} 2", [0.25, "b"], control=True)]
    return ScoreTable(evil, evil, [Column(evil, "high", note=evil), Column("more")], rows)


@pytest.mark.parametrize("evil", EVIL)
def test_comparison(evil):
    harmless(comparison_page(evil, [made_table(evil)], lead=evil, facts={evil: evil}), evil)


@pytest.mark.parametrize("evil", EVIL)
def test_run(evil, tmp_path):
    run = start_run(tmp_path / "run", resolve("small"), {evil: evil, "pictures": evil}, evil)
    text = run.config.read_text()
    run.config.write_text(text.replace("preset: small", f"preset: {json.dumps(evil)}"))
    for images in (8, 16):
        append_metrics(run, {"kind": "train", "images": images, "seconds": 1, evil: 0.5, "l1": 0.5 / images})
        append_metrics(run, {"kind": evil, "images": images, "text": evil})
        append_metrics(run, {"kind": "note", "images": images, "text": evil})
    append_metrics(run, {"kind": "collapse", "images": 16, evil: evil})
    harmless(run_page(run.path), evil)


@pytest.mark.parametrize("evil", EVIL)
def test_doctor(evil):
    images = np.random.default_rng(0).integers(0, 256, (24, 3, 32, 32), dtype=np.uint8)
    images[1] = images[0]
    names = tuple(f"{evil}{number}.png" for number in range(24))
    labels = {evil: np.array([evil, "b"] * 12)}
    pictures = ImageSet(images, names, labels, source=evil, skipped=(Skipped(evil, evil),))
    harmless(doctor_page(doctor(pictures)), evil)


@pytest.mark.parametrize("evil", EVIL)
def test_explanation(evil):
    generator = np.random.default_rng(0)
    features = {name: generator.standard_normal((90, 3)).astype(np.float32) for name in ("geometry", "light")}
    classes = np.where(features["light"][:, 0] > 0, evil, "b")
    rows = Rows(np.arange(60, 90), {40: np.arange(40)[None]})
    task = task_of({evil: classes})
    shares = explain_labels(features, task, rows, seeds=(0,))
    sheets = {evil: {"grad-cam": Image.new("RGB", (8, 8))}}
    images = ImageSet(np.zeros((1, 3, 8, 8), np.uint8), (evil,), source=evil)
    pair = (evil, evil), pair_parts(features, 0, 1)
    model, clusters = SimpleNamespace(source=evil), cluster_shares(features, np.arange(90) % 2)
    result = explanation.Explained(shares, model, images, task, rows, clusters, pair)
    harmless(explanation_page(result, sheets), evil)


def test_a_name_with_dollars_is_text_and_no_formula():
    svg = charts.bars({"$\\frac$": 1.0, "cost $5 to $9": 2.0}, "$a_", ["$\\frac$"])
    assert "$\\frac$" in svg and "cost $5 to $9" in svg and "$a_" in svg
