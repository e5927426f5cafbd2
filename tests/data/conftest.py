"""Makes small images and trees of them; none shows anything but noise and ramps."""

import io
import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from PIL import Image


def noise(seed: int, width: int = 12, height: int = 12, channels: int = 3) -> np.ndarray:
    shape = (height, width, channels) if channels > 1 else (height, width)
    return np.random.default_rng(seed).integers(0, 256, shape, dtype=np.uint8)


def encode(what: int | np.ndarray | Image.Image, form: str = "PNG", **options: object) -> bytes:
    """A small image of noise by its seed, or the given one, encoded."""
    array = noise(what) if isinstance(what, int) else what
    picture = array if isinstance(array, Image.Image) else Image.fromarray(array)
    buffer = io.BytesIO()
    picture.save(buffer, form, **options)
    return buffer.getvalue()


@pytest.fixture
def encoded() -> Callable[..., bytes]:
    return encode


@pytest.fixture
def tree(tmp_path: Path) -> Callable[..., Path]:
    """``tree(files, zipped)`` writes a folder or zip: each name gets its own image or what is given."""

    def make(
        files: list[str] | dict[str, bytes | str | None], zipped: bool = False, name: str = "set"
    ) -> Path:
        contents = dict.fromkeys(files) if isinstance(files, list) else files
        return write_tree(tmp_path / name, contents, zipped)

    return make


def write_tree(place: Path, contents: dict[str, bytes | str | None], zipped: bool = False) -> Path:
    data = {file: encode(at) if one is None else one for at, (file, one) in enumerate(contents.items())}
    if zipped:
        path = place.with_name(f"{place.name}.zip")
        with zipfile.ZipFile(path, "w") as archive:
            for file, content in data.items():
                archive.writestr(file, content)
        return path
    for file, content in data.items():
        path = place / file
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(content.encode() if isinstance(content, str) else content)
    return place


@pytest.fixture
def numbers() -> np.random.Generator:
    return np.random.default_rng(3)
