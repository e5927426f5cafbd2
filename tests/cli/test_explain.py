"""`derender explain`: a folder with page, chart, maps and probe, numbers as JSON, bad words refused."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from tests.cli.conftest import run

import derender
from derender.data import read_images
from derender.features import FeatureTable
from derender.interpretation import load_probe, question
from derender.interpretation.explanation import split_rows

SIZE = 32


@pytest.fixture(scope="module")
def data(tmp_path_factory) -> Path:
    """Two classes of noise, one dark and one bright: anything that sees can tell them apart."""
    folder = tmp_path_factory.mktemp("explain") / "pictures"
    generator = np.random.default_rng(0)
    for place in range(60):
        name = ("dark", "bright")[place % 2]
        (folder / name).mkdir(parents=True, exist_ok=True)
        noise = generator.integers(0, 100, (SIZE, SIZE, 3)) + 150 * (place % 2)
        Image.fromarray(noise.astype(np.uint8)).save(folder / name / f"{place:02}.png")
    return folder


@pytest.fixture(scope="module")
def why(tiny, data, tmp_path_factory) -> tuple[Path, dict]:
    """One explanation with everything in it."""
    folder = tmp_path_factory.mktemp("explain")
    words = ["explain", "-m", tiny, "-d", data, "-l", "class", "--seeds", 2, "--sheets", 1, "--rows", 2]
    words += ["--clusters", "2", "--pair", "dark/00.png", "dark/02.png", "--json", folder / "why.json"]
    words += ["--markdown", folder / "why.md", "--latex", folder / "why.tex"]
    assert run(*words, "--out", folder / "why") == 0
    return folder / "why", json.loads((folder / "why.json").read_text())


def test_tables_are_written_as_text(why):
    folder, _ = why
    text, typeset = (folder.with_suffix(form).read_text() for form in (".md", ".tex"))
    assert text.count("| :--- |") == typeset.count(r"\begin{table}") == 5
    assert "| *shuffled labels* |" in text and r"\textit{untrained" in typeset
    assert "| cluster 0 |" in text and "dark/00.png and dark/02.png" in text


def test_the_folder_holds_page_chart_maps_and_probe(why):
    folder, _ = why
    names = sorted(path.name for path in folder.iterdir())
    assert {"explain.html", "probe", "shares.png", "shares.svg"} <= set(names)
    maps = [name for name in names if name.startswith("maps-1-")]
    assert len(maps) == 5 and any("hires-cam" in name for name in maps)
    page = (folder / "explain.html").read_text()
    for word in ("Shares of the factors", "Checks of the maps", "most alike in", "shuffled labels"):
        assert word in page
    assert 'alt="the image dark/00.png"' in page and 'alt="the image dark/02.png"' in page
    assert "http://" not in page.replace("http://www.w3.org", "") and "<script src" not in page
    with Image.open(folder / "shares.png") as chart:
        assert chart.width > 800
    assert load_probe(folder / "probe").factors == ("geometry", "albedo", "light", "camera")


def test_the_numbers_add_up(why):
    _, told = why
    assert list(told["rows"]) == ["model", "shuffled labels", "untrained encoder"]
    answers = told["rows"]["model"]["answers"]
    for answer in answers.values():
        assert sum(part["share"] for part in answer["factors"].values()) == pytest.approx(1)
        assert answer["auc"] > 0.95
    assert told["rows"]["model"]["completeness_error"] < 1e-6
    assert sum(told["pair"]["distance_share"]) == pytest.approx(1)
    np.testing.assert_allclose(np.sum(told["clusters"]["share"], axis=1), 1)
    checked = {(row["method"], row["factor"], row["changed"]) for row in told["sanity"]}
    assert len(checked) == 3 * 4 * 3


def test_bad_words(tiny, data, why, tmp_path, refused):
    words = ("explain", "-m", tiny, "-d", data)
    assert f"unknown label of {data} 'clas'; did you mean 'class'" in refused(*words, "-l", "clas")
    assert "give either --label NAME" in refused(*words)
    words = (*words, "-l", "class")
    assert "add --force to replace it" in refused(*words, "--out", why[0])
    assert "needs 20 or more" in refused(*words, "--limit", "12")
    assert "no image 'dark/0.png'; did you mean 'dark/" in refused(*words, "--pair", "dark/0.png", "x")
    assert "unknown head 'lin'" in refused(*words, "--head", "lin")
    for place in range(24):
        Image.fromarray(np.full((SIZE, SIZE, 3), place * 9, np.uint8)).save(tmp_path / f"{place}.png")
    told = refused("explain", "-m", tiny, "-d", tmp_path, "-l", "class")
    assert "has no labels, and an explanation needs" in told


def test_yes_no_labels_with_one_answer_are_left_out_and_named(tiny, data):
    images = read_images(data, SIZE)
    bright = (images.labels["class"] == "bright").astype(np.int8)
    results = derender.explain(replace(images, labels={"bright": bright, "never": 0 * bright}), tiny, seeds=1)
    assert results.task.names == ("bright",) and results.scores.notes[-1].endswith("answers: never")
    assert repr(results) == results.scores.to_markdown()


def test_pictures_that_are_all_their_owners_test_part_are_split_here():
    labels = {"class": np.array(["a", "b"] * 20), "partition": np.array(["test"] * 40)}
    table = FeatureTable(tuple(map(str, range(40))), {"geometry": np.eye(40)}, labels)
    rows = split_rows(question(labels, ["class"]), table, 10, range(2), None)
    assert len(rows.test) >= 10 and rows.train[10].shape == (2, 10)
    owners = {**labels, "partition": np.array(["train"] * 30 + ["test"] * 10)}
    rows = split_rows(question(owners, ["class"]), replace(table, labels=owners), 10, range(1), None)
    assert rows.test.tolist() == list(range(30, 40))
