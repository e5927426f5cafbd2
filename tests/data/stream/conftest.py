"""Writes shards: ``shard(name, {member: content})`` where None is a small image of its own."""

import io
import tarfile
from collections.abc import Callable
from pathlib import Path

import pytest
from tests.data.conftest import encode


@pytest.fixture(autouse=True)
def cache(tmp_path: Path, monkeypatch) -> Path:
    """A cache of our own."""
    monkeypatch.setenv("DERENDER_CACHE", str(tmp_path / "cache"))
    return tmp_path / "cache"


def write_shard(path: Path, members: dict[str, bytes | str | None], mode: str = "w", first: int = 0) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    with tarfile.open(path, mode) as tar:
        for seed, (member, content) in enumerate(members.items(), first):
            data = encode(seed) if content is None else content
            data = data.encode() if isinstance(data, str) else data
            info = tarfile.TarInfo(member)
            info.size = len(data)
            tar.addfile(info, io.BytesIO(data))
    return path


@pytest.fixture
def shard(tmp_path: Path) -> Callable[..., Path]:
    return lambda name, *members, **how: write_shard(tmp_path / name, *members, **how)
