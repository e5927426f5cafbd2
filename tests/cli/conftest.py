"""What tests of commands share: words of any kind, refusals and generated faces."""

import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from derender.cli import main
from derender.data.synthetic.faces import generate

TINY = ("image_size=32", "width=4", "light_width=4", "perceptual=none")


def run(*words: object) -> int:
    """The exit code of a command."""
    return main([str(word) for word in words])


def settings(*pairs: str) -> list[str]:
    """``--set`` before each."""
    return [word for pair in pairs for word in ("--set", pair)]


SETTINGS = ["--preset", "small", *settings(*TINY, "batch_size=4", "images=8")]


def noise(folder: Path, count: int, size: int = 32, cells: int = 4, name: str = "{}.png") -> Path:
    """A folder of so many images of coloured noise."""
    for number in range(count):
        coarse = np.random.default_rng(number).integers(0, 256, (cells, cells, 3), dtype=np.uint8)
        file = folder / name.format(number)
        file.parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(coarse).resize((size, size)).save(file)
    return folder


def coloured_people(folder: Path, count: int, size: int) -> Path:
    """Images of four made-up people, one folder each, distinguished by their colour."""
    rng, colours = np.random.default_rng(0), ((200, 40, 40), (40, 200, 40), (40, 40, 200), (200, 200, 40))
    for row in range(count):
        pixels = np.clip(colours[row % 4] + rng.integers(-30, 30, (size, size, 3)), 0, 255).astype(np.uint8)
        (folder / "abcd"[row % 4]).mkdir(parents=True, exist_ok=True)
        Image.fromarray(pixels).save(folder / "abcd"[row % 4] / f"{row:03d}.png")
    return folder


def face_files(folder: Path, count: int, seed: int) -> Path:
    """A folder of so many generated faces of 64 pixels."""
    folder.mkdir(exist_ok=True)
    for number, image in enumerate(generate(count, 64, seed=seed).images):
        Image.fromarray(image.transpose(1, 2, 0)).save(folder / f"{number:03d}.png")
    return folder


@pytest.fixture
def numbers(capsys):
    """Run a command that must succeed; gives what --json says, and the notes."""

    def call(*words: object) -> tuple[dict, str]:
        capsys.readouterr()
        assert run(*words, "--json", "-") == 0
        shown = capsys.readouterr()
        return json.loads(shown.out), shown.err

    return call


@pytest.fixture
def refused(capsys):
    """Run a command that must fail with exit code 2 and one line of complaint, the last; gives that line."""

    def call(*words: object) -> str:
        capsys.readouterr()
        assert run(*words) == 2
        *notes, last = capsys.readouterr().err.strip().splitlines()
        assert last.startswith("derender: ")
        assert not any(note.startswith(("derender:", "Traceback")) for note in notes)
        return last

    return call


@pytest.fixture(scope="session")
def faces(tmp_path_factory) -> Path:
    """Forty generated faces with ground truth, as `synth faces` writes them."""
    folder = tmp_path_factory.mktemp("made") / "faces"
    assert run("synth", "faces", "--out", folder, "--count", 40, "--image-size", 32) == 0
    return folder


@pytest.fixture(scope="session")
def trained(faces: Path, tmp_path_factory) -> Path:
    """A run folder of a training that lasted two steps."""
    folder = tmp_path_factory.mktemp("cli") / "run"
    assert run("train", "--data", faces, "--out", folder, *SETTINGS) == 0
    return folder
