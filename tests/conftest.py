"""Fixtures every test may use: development data beside the checkout, seeds, tolerances."""

import os
from pathlib import Path

import pytest
import torch

ROOT = Path(__file__).resolve().parents[1]


LONGEST = ("test_pyright_finds_nothing", "test_readers_refuse_what_is_broken", "test_two_processes")


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """The longest tests begin first, so that no worker ends with one alone."""
    items.sort(key=lambda item: not item.name.startswith(LONGEST))


def shared_folder() -> Path | None:
    """Where the development data lies: $DERENDER_SHARED, or ``shared`` beside the checkout, or None."""
    candidates = (
        [Path(os.environ["DERENDER_SHARED"])] if "DERENDER_SHARED" in os.environ else [ROOT.parent / "shared"]
    )
    return next((path for path in candidates if path.is_dir()), None)


@pytest.fixture
def shared_data():
    """``shared_data("data/utkface64.zip")`` gives the path, or skips the test and says what is missing."""

    def find(name: str) -> Path:
        folder = shared_folder()
        if folder is None or not (folder / name).exists():
            pytest.skip(
                f"development data {name} is not here (set DERENDER_SHARED to the folder that holds it)"
            )
        return folder / name

    return find


@pytest.fixture
def generator() -> torch.Generator:
    return torch.Generator().manual_seed(0)
