"""What is told of a model with images at hand; a part that cannot be made is named, the others stand."""

import numpy as np
import pytest

from derender import Derenderer
from derender.data import ImageSet
from derender.report.evidence import Subject, gather, suitable_label
from derender.report.run import run_page
from derender.training.config import resolve
from derender.training.run_folder import start_run

COUNT = 48


@pytest.fixture(scope="module")
def model() -> Derenderer:
    return Derenderer.from_preset("small", seed=0, image_size=32, width=4, light_width=4).eval()


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


def test_everything_that_can_be_told_is_told_and_escaped(model, pictures, tmp_path):
    pytest.importorskip("captum")
    done = []
    result = gather(Subject(model, pictures, pictures, "All of them"), lambda *step: done.append(step))
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
