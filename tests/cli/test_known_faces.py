"""`derender evaluate identify`, `verify`, `light`: tables, halves, and ways to get them wrong."""

import numpy as np
import pytest
from PIL import Image

QUICK = ["--resamples", "20"]
EMBEDDED = [*QUICK, "--untrained-seeds", "1", "--cache", "none"]


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> str:
    """Eight people of noise under three lights, named as in the cropped Extended Yale B."""
    folder, rng = tmp_path_factory.mktemp("yale"), np.random.default_rng(0)
    for person in range(1, 9):
        face = rng.integers(60, 200, (96, 84))
        for azimuth, gain in ((0, 1.0), (20, 0.9), (70, 0.6)):
            pixels = (face * gain + rng.integers(0, 9, face.shape)).astype(np.uint8)
            Image.fromarray(pixels).save(folder / f"yaleB{person:02d}_P00A{azimuth:+04d}E+00.png")
    return str(folder)


def test_identification_by_light_of_one_half(tiny, folder, numbers, tmp_path):
    words = ["evaluate", "identify", folder, "-m", tiny, "--half", "test", *EMBEDDED]
    result, notes = numbers(*words, "--markdown", tmp_path / "table.md")
    people = result["people"]
    assert 0 < people < 8 and result["half"] == "test" and "half=test" in notes
    assert result["probes"] == {"all": 2 * people, "<= 25": people, "<= 77": people}
    assert result["rows"]["Gradientfaces"]["scores"]["<= 25"]["value"] == 1
    assert "nearest by cosine less the mean of the gallery; test half" in (tmp_path / "table.md").read_text()
    rest, _ = numbers(*[word if word != "test" else "development" for word in words])
    assert rest["people"] == 8 - people and not set(rest["gallery"]) & set(result["gallery"])


def test_light_against_the_names(tiny, folder, numbers):
    result, _ = numbers("evaluate", "light", folder, "-m", tiny, *QUICK)
    rows = result["azimuth"]
    assert result["pictures"] == 24 and set(rows) == {"model", "untrained model", "constant answer"}
    assert rows["constant answer"]["scores"]["error"]["value"] == pytest.approx(80 / 3, rel=1e-4)


def test_what_is_wrong_is_named(tiny, folder, refused, tmp_path):
    (tmp_path / "pairs.txt").write_text("1 1\nAda 1 2\nAda 1 Bo 1\n")
    words = ["evaluate", "verify", folder, "-m", tiny, "--pairs", tmp_path / "pairs.txt", *EMBEDDED]
    assert "3 of 3 images of the pairs are not there (first Ada_0001)" in refused(*words)
    assert "has no labels camera_y_rad" in refused("evaluate", "pose", folder, "-m", tiny, *QUICK)
