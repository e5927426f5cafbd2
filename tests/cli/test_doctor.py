"""`derender doctor` from a person's side: what it says, what it writes, and what it refuses."""

from pathlib import Path

import pytest
from tests.cli.conftest import noise

from derender.cli import main


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Twenty-six images of noise, one of them twice, and one that cannot be read."""
    made = noise(tmp_path / "set", 26, 64, cells=64, name="{:02}.png")
    (made / "26.png").write_bytes((made / "00.png").read_bytes())
    (made / "27.png").write_bytes(b"no picture")
    return made


def test_terminal_page_and_json_tell_the_same(folder: Path, tmp_path: Path, numbers):
    page = tmp_path / "doctor.html"
    told, printed = numbers("doctor", folder, "--out", page)
    assert told["verdict"] == "does not suit" and told["distinct"] == 26 and told["identical"] == 1
    assert told["copies"] == [{"file": "26.png", "first": "00.png"}]
    assert [row["file"] for row in told["unreadable"]] == ["27.png"]
    assert told["originals"]["median_short"] == 64
    assert f"verdict: does not suit, because {'; '.join(told['because'])}" in printed
    assert "unreadable: 27.png" in printed
    assert main(["doctor", str(folder)]) == 0 and main(["doctor", str(folder), "--check"]) == 1
    html = page.read_text()
    assert 'data-value="26">26' in html  # the table of measures: distinct images
    for finding in told["findings"]:
        assert finding["text"] in html and finding["text"] in printed


def test_what_exists_is_not_replaced_unasked(folder: Path, tmp_path: Path, refused):
    page = tmp_path / "doctor.html"
    page.write_text("mine")
    assert "exists already" in refused("doctor", folder, "--out", page)
    assert "exists already" in refused("doctor", folder, "--json", page)
    assert "is a folder" in refused("doctor", folder, "--out", tmp_path)
    assert page.read_text() == "mine"
    assert main(["doctor", str(folder), "--out", str(page), "--force"]) == 0
    assert "mine" not in page.read_text()[:10]


def test_what_is_no_set_of_pictures_is_refused(folder: Path, tmp_path: Path, refused):
    empty, broken, text = tmp_path / "empty", tmp_path / "broken", tmp_path / "notes.txt"
    empty.mkdir()
    broken.mkdir()
    (broken / "a.png").write_bytes(b"no picture")
    text.write_text("no image")
    assert "no images found" in refused("doctor", empty)
    assert "none of the 1 images" in refused("doctor", broken)
    assert "is no folder, zip or image" in refused("doctor", text)
    assert "is one image: a set is examined" in refused("doctor", folder / "00.png")
    assert "does not exist" in refused("doctor", tmp_path / "nowhere")
