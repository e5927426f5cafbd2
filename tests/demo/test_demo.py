"""The demo from end to end in a very small setting: it must hold together, not impress."""

import json
import re
from collections.abc import Callable
from contextlib import redirect_stdout
from dataclasses import replace
from io import StringIO
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from tests.cli.conftest import face_files

import derender.demo as package
from derender.cli import main
from derender.demo import DemoSettings, demo_page, run_demo, run_own_demo
from derender.demo.page import score_tables
from derender.demo.story import STAGES
from derender.evaluation.truth import GeometryResult

TINY = DemoSettings(
    train_pictures=24, test_pictures=16, images=16, minutes=5, fit_steps=2, shown=2, films=1, portrait_px=64,
    overrides=("image_size=32", "width=4", "light_width=4", "batch_size=8",
               "objective.self_features_steps=1", "whitening.spatial=false"),
)  # fmt: skip


@pytest.fixture(scope="module")
def told(tmp_path_factory):
    """What the command's demo gave (``result``), the stages it reported, where it wrote, what it printed."""
    place, stages, printed, results = tmp_path_factory.mktemp("demo"), [], StringIO(), []

    def heard(out: Path, settings: DemoSettings, *, report: Callable[..., None], **how):
        def told(stage: str, *at: object) -> None:
            stages.append(stage)
            report(stage, *at)

        results.append(run_demo(place / out, settings, report=told, **how))
        return results[0]

    with pytest.MonkeyPatch.context() as patch, redirect_stdout(printed):
        patch.setattr(package, "QUICK", TINY)
        patch.setattr(package, "run_demo", heard)
        patch.chdir(place)
        assert main(["demo", "--quick", "--seed", "3", "--json", "numbers.json"]) == 0
    stages = list(dict.fromkeys(stages))
    return SimpleNamespace(result=results[0], stages=stages, place=place, printed=printed.getvalue())


@pytest.fixture(scope="module")
def html(told) -> str:
    return (told.place / "derender-demo" / "report.html").read_text()


def test_every_stage_happens_in_order_and_scores_stand_beside_their_controls(told):
    result = told.result
    assert told.stages == ["editing photographs", *STAGES]
    assert set(result.seconds) == set(STAGES)
    assert result.trained.images == 16
    tables = score_tables(result)
    rows = list(tables["clustering"].values())
    assert rows[0] == "geometry + albedo" and {"untrained encoder", "pixels", "HOG", "chance"} <= {*rows}
    models = ["this run, 2 steps per image", "this run, feed-forward"]
    assert list(tables["geometry"].values()) == [*models, "average depth", "plane", "untrained model"]
    assert result.reconstruction.mean_picture.l1 > 0
    assert len(set(result.clusters)) == len(set(result.identities)) == 2
    seen = {picture.tobytes() for picture in result.seen.images}
    assert not seen & {picture.tobytes() for picture in result.truth.images}


def test_command_writes_numbers_and_page_with_every_column_beside_the_bundled_model(told, html):
    result = told.result
    assert f"{100 * result.geometry.model.side:.3f}" in html
    shown = ("reconstruction", "another light", "another view", "true depth", "true albedo", "Gradientfaces")
    assert all(word in html for word in shown)
    assert html.count("<img") >= 2 * 8 + 2 * 7 + 2 + 4 * 5
    assert not re.search(r'(?:src|href|srcset)="(?!data:|#)', html)
    assert "The bundled model" in html
    assert html.count("by rendered-faces-64: the light goes round") == 4
    for column in ("reconstruction", "normals", "albedo", "another view"):
        assert f"{column}, rendered-faces-64: rendered face 4" in html
    assert "rendered-faces-64" not in result.geometry_beside  # 32 pixels, not 64
    assert told.printed.strip().splitlines()[-1] == "report derender-demo/report.html"
    assert len(html) > 20_000
    numbers = json.loads((told.place / "numbers.json").read_text())
    assert numbers["geometry"]["plane"]["MAD"] > 0 and numbers["clustering"]["pixels"]["accuracy"] > 0


def test_sentences_follow_the_numbers(told):
    result = told.result
    geometry = result.geometry
    side, mad = geometry.plane.side_each, np.ones_like(geometry.plane.mad_deg_each)
    better = replace(geometry.model, side_each=side / 100, mad_deg_each=0.1 * mad)
    worse = replace(geometry.model, side_each=100 * side, mad_deg_each=179.0 * mad)
    page = demo_page(result)
    for scores, printed in ((better, "better than every control"), (worse, "behind the strongest control")):
        other = GeometryResult(scores, geometry.average_depth, geometry.plane, None)
        changed = replace(result, geometry=other)
        tables = score_tables(changed)
        assert all(printed in tables["geometry"].verdict(column) for column in (0, 1))
        html = replace(page, values={**page.values, "result": changed, "tables": tables}).html()
        assert f"Depth</dt><dd>{printed}" in html
        assert ("Not ahead of every control: depth" in html) == (scores is worse)


def test_a_folder_of_ones_own_opens_with_photographs_and_ends_with_its_run(tmp_path, monkeypatch):
    monkeypatch.setattr("derender.demo.story.SHOWN", 2)
    photos, pages = face_files(tmp_path / "photos", 24, seed=5), []
    page = run_own_demo(photos, tmp_path / "out", TINY, opened=lambda page: pages.append(page.read_text()))
    assert 'http-equiv="refresh"' in pages[0] and "lit from the left" in pages[0]
    html = page.read_text()
    assert "lit from the left" in html and "Decomposed" in html and "refresh" not in html
    with pytest.raises(FileExistsError, match="not empty"):
        run_own_demo(photos, tmp_path / "out", TINY)


def test_both_models_are_scored_on_the_same_faces(told):
    result = told.result
    geometry = result.geometry
    each = np.full_like(geometry.model.side_each, 0.001)
    better = replace(geometry, model=replace(geometry.model, side_each=each))
    table = score_tables(replace(result, geometry_beside={"rendered-faces-64": better}))["geometry"]
    assert [row.name for row in table.rows][:2] == ["this run, 2 steps per image", "rendered-faces-64"]
    assert table.rows[0].cells[0] == pytest.approx(100 * geometry.model.side)
    assert table.rows[1].cells[0] == pytest.approx(0.1)
    assert not table.rows[1].control
