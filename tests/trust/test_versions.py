"""constraints-lowest.txt holds the lower bound of every dependency; constraints.txt is not below them."""

import re
import tomllib
from pathlib import Path

from packaging.version import Version

ROOT = Path(__file__).resolve().parents[2]


def pinned(name: str) -> dict[str, str]:
    rows = (ROOT / name).read_text().splitlines()
    return {plain(row.split("==")[0]): row.split("==")[1] for row in rows if "==" in row and row[0] != "#"}


def plain(name: str) -> str:
    return re.split(r"[\[;]", name)[0].strip().lower().replace("_", "-")


def bounds() -> dict[str, str]:
    """Every dependency that the package or an extra asks for, with its lower bound."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    extras = [one for extra in project["optional-dependencies"].values() for one in extra]
    pairs = [one.split(">=") for one in (*project["dependencies"], *extras)]
    return {plain(name): bound.strip() for name, bound in pairs}


def test_every_lower_bound_is_pinned_as_it_stands():
    lowest = pinned("constraints-lowest.txt")
    for name, bound in bounds().items():
        assert Version(lowest[name]) == Version(bound), f"{name}: {lowest[name]} is not the bound {bound}"


def test_nothing_is_tested_below_its_bound():
    newest = pinned("constraints.txt")
    there = {name: bound for name, bound in bounds().items() if name in newest}
    assert len(there) > 20
    for name, bound in there.items():
        assert Version(newest[name]) >= Version(bound), name
