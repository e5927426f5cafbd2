"""docs/licences.md names every package that pyproject.toml asks for, with a licence."""

import re
import tomllib
from pathlib import Path

from packaging.requirements import Requirement

ROOT = Path(__file__).resolve().parents[2]


def test_every_package_that_is_asked_for_has_a_licence_on_the_page():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())
    asked = [*project["project"]["dependencies"], *project["dependency-groups"]["dev"]]
    asked += [text for wanted in project["project"]["optional-dependencies"].values() for text in wanted]
    rows = re.findall(
        r"^\| \[?([\w.-]+).* \| (.+) \|$", (ROOT / "docs" / "licences.md").read_text(), re.MULTILINE
    )
    listed = dict(rows)
    names = {re.sub(r"[-_.]+", "-", Requirement(text).name).lower() for text in asked}
    assert not names - listed.keys(), "run: python tests/trust/licences.py"
    assert all(licence.strip() for licence in listed.values())
