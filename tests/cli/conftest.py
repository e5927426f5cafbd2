"""What tests of commands share: words of any kind, refusals, the smallest model and generated faces."""

from pathlib import Path

import pytest

from derender import Derenderer
from derender.cli import main

TINY = ("image_size=32", "width=4", "light_width=4", "perceptual=none")


def run(*words: object) -> int:
    """The exit code of a command."""
    return main([str(word) for word in words])


def settings(*pairs: str) -> list[str]:
    """``--set`` before each."""
    return [word for pair in pairs for word in ("--set", pair)]


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
def tiny(tmp_path_factory) -> Path:
    """An untrained model of the smallest kind, for 32 pixels, saved."""
    made = Derenderer.from_preset("small", seed=0, image_size=32, width=4, light_width=4)
    return made.save(tmp_path_factory.mktemp("tiny") / "model")


@pytest.fixture(scope="session")
def faces(tmp_path_factory) -> Path:
    """Forty generated faces with ground truth, as `synth faces` writes them."""
    folder = tmp_path_factory.mktemp("made") / "faces"
    assert run("synth", "faces", "--out", folder, "--count", 40, "--image-size", 32) == 0
    return folder
