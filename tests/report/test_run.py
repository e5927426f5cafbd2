"""A run's page is made from its folder alone, also from one that broke off, and of images at hand.

A part that cannot be made is named, the others stand.
"""

import numpy as np
import pytest
from PIL import Image

from derender.data import ImageSet
from derender.report.run import Subject, gather, loss_charts, run_page, suitable_label
from derender.training.config import resolve
from derender.training.run_folder import append_metrics, start_run

COUNT = 48


def test_page_of_a_run_shows_curves_samples_settings_and_what_failed(tmp_path):
    run = start_run(tmp_path / "run", resolve("small", ["seed=7"]), {"pictures": 12}, "cpu")
    assert "Nothing was logged yet." in run_page(run.path).html()
    for images in (32, 64, 96):
        row = {"images": images, "seconds": 1.0, "l1": 1 / images}
        append_metrics(run, {"kind": "train", **row, "images_per_second": 9})
        append_metrics(run, {"kind": "validation", **row, "loss": -images})
        Image.new("RGB", (8, 8)).save(run.samples / f"{images:09d}.png")
    why = {"flat": "depth is <flat>: lower the rate"}
    append_metrics(run, {"kind": "collapse", "images": 96, "seconds": 1.0, **why})
    html = run_page(run.path).html()
    assert html.count("<svg") == 2 and "held out" in html
    assert "The watcher stopped this run." in html and "depth is &lt;flat&gt;" in html
    assert "After 32 images." in html and "After 96 images." in html
    assert "<dt>seed</dt><dd>7</dd>" in html and "<dt>pictures</dt><dd>12</dd>" in html


@pytest.mark.parametrize(("keep", "told"), [("best", True), ("last", False)])
def test_the_page_says_of_which_weights_the_model_is(tmp_path, keep, told):
    run = start_run(tmp_path / "run", resolve("small", [f"keep={keep}"]), {}, "cpu")
    for images, loss in ((32, 1.0), (64, 0.5), (96, 0.75)):
        append_metrics(run, {"kind": "validation", "images": images, "seconds": 1.0, "loss": loss})
    printed = "<dt>weights of the model</dt><dd>after 64 images, the best on held-out ones</dd>"
    assert (printed in run_page(run.path).html()) == told


def test_only_first_last_and_evenly_chosen_samples_are_shown(tmp_path):
    run = start_run(tmp_path / "run", resolve("small"), {}, "cpu")
    for images in range(1, 21):
        Image.new("RGB", (8, 8)).save(run.samples / f"{images:09d}.png")
    html = run_page(run.path).html()
    shown = [number for number in range(1, 21) if f"After {number} images." in html]
    assert len(shown) == 4 and shown[0] == 1 and shown[-1] == 20


def test_curves_need_two_points_and_leave_out_what_is_no_number():
    logged = ((1, 0.5), (2, float("nan")), (3, None))
    rows = [{"kind": "train", "images": images, "l1": value} for images, value in logged]
    assert loss_charts(rows) == []
    assert len(loss_charts([*rows, {"kind": "train", "images": 4, "l1": 0.25}])) == 1


@pytest.fixture(scope="module")
def pictures() -> ImageSet:
    """Coloured noise, brighter where the label says so; one name is markup."""
    generator = np.random.default_rng(0)
    bright = np.arange(COUNT) % 2
    images = generator.integers(0, 156, (COUNT, 3, 4, 4)) + 100 * bright[:, None, None, None]
    return ImageSet(
        images.repeat(8, axis=2).repeat(8, axis=3).astype(np.uint8),
        ("<script>.png", *(f"{number}.png" for number in range(1, COUNT))),
        {"number": np.arange(COUNT), "tone": np.where(bright, "bright", "dark")},
        source="noise",
    )


def test_everything_that_can_be_told_is_told_and_escaped(smallest, pictures, tmp_path):
    pytest.importorskip("captum")
    done = []
    subject = Subject(smallest.eval(), pictures, pictures, "All of them")
    result = gather(subject, lambda *step: done.append(step))
    assert list(result.sections) == ["data", "decomposed", "films", "scores", "card", "explained"]
    assert result.failed == [] and done == [(step, 6) for step in range(7)]
    html = run_page(start_run(tmp_path / "run", resolve("small"), {}, "cpu").path, result).html()
    assert "<script>.png" not in html and "&lt;script&gt;.png" in html
    for told in ("All of them", "mean image", "no exact depth", "shuffled labels", "tone", "Swap test"):
        assert told in html
    assert html.count("prefers-reduced-motion") == 2


def test_the_suitable_label_has_few_classes_with_pictures_enough(pictures):
    assert suitable_label(pictures) == ("tone",)
    names = np.array([f"id{number}" for number in range(COUNT)])
    rare = np.where(np.arange(COUNT) < 5, "rare", "usual")
    alone = ImageSet(pictures.images, pictures.files, {"identity": names, "rare": rare})
    assert suitable_label(alone) == ()
