"""Writes docs/licences.md: every package that derender needs or can use, with version, licence and home.

    python tests/trust/licences.py

Read from what is installed (importlib.metadata): the packages that pyproject.toml names, and those that they
need in turn. Nothing is asked of a network.
"""

import re
import tomllib
from collections.abc import Iterable
from dataclasses import dataclass
from importlib.metadata import Distribution, PackageNotFoundError, distribution
from pathlib import Path

from packaging.requirements import Requirement

ROOT = Path(__file__).resolve().parents[2]
PAGE = ROOT / "docs" / "licences.md"
NAMED = {
    "BSD License": "BSD",
    "MIT License": "MIT",
    "Apache Software License": "Apache-2.0",
    "Python Software Foundation License": "PSF-2.0",
}


@dataclass(frozen=True)
class Package:
    """One row: name, version, licence and home page."""

    name: str
    version: str
    licence: str
    home: str


def plain(name: str) -> str:
    """The name as indices write it."""
    return re.sub(r"[-_.]+", "-", name).lower()


def needed(requirements: Iterable[str]) -> dict[str, Distribution | None]:
    """The packages that requirements name and those that these need, by name; None: not installed here."""
    found: dict[str, Distribution | None] = {}
    waiting = [Requirement(text) for text in requirements]
    while waiting:
        wanted = waiting.pop()
        if wanted.marker is not None and not any(
            wanted.marker.evaluate({"extra": extra}) for extra in ("", *wanted.extras)
        ):
            continue
        name = plain(wanted.name)
        if name in found and not wanted.extras:
            continue
        try:
            found[name] = distribution(name)
        except PackageNotFoundError:
            found[name] = None
            continue
        for text in found[name].requires or ():
            below = Requirement(text)
            if below.marker is None or any(below.marker.evaluate({"extra": e}) for e in ("", *wanted.extras)):
                below.marker = None
                if plain(below.name) not in found:
                    waiting.append(below)
    return found


def licence_of(package: Distribution) -> str:
    """What a package says of its licence: the expression, the classifiers, or the first line of the field."""
    about = package.metadata
    if about.get("License-Expression"):
        return about["License-Expression"]
    classified = [
        line.rsplit(" :: ", 1)[-1] for line in about.get_all("Classifier") or () if line.startswith("License")
    ]
    classified = [NAMED.get(one, one) for one in classified if one != "OSI Approved"]
    if classified:
        return ", ".join(dict.fromkeys(classified))
    stated = (about.get("License") or "").strip().splitlines()
    return stated[0][:60] if stated else "not stated"


def home_of(package: Distribution) -> str:
    about = package.metadata
    links = dict(one.split(", ", 1) for one in about.get_all("Project-URL") or () if ", " in one)
    kinds = {name.lower(): link for name, link in links.items()}
    stated = about.get("Home-page")
    for kind in ("homepage", "home", "source", "repository", "source code", "github"):
        stated = stated if stated and stated != "UNKNOWN" else kinds.get(kind)
    return stated or ""


def rows(found: dict[str, Distribution | None]) -> list[Package]:
    return [
        Package(name, "", "not installed where this page was made", "")
        if package is None
        else Package(name, package.version.partition("+")[0], licence_of(package), home_of(package))
        for name, package in sorted(found.items())
    ]


def table(packages: list[Package]) -> list[str]:
    lines = ["| package | version | licence |", "| --- | --- | --- |"]
    for one in packages:
        shown = f"[{one.name}]({one.home})" if one.home.startswith("http") else one.name
        lines.append(f"| {shown} | {one.version} | {one.licence.replace('|', '/')} |")
    return lines


def page() -> str:
    """The whole page."""
    document = tomllib.loads((ROOT / "pyproject.toml").read_text())
    project = document["project"]
    base = needed(project["dependencies"])
    extras = needed(text for wanted in project["optional-dependencies"].values() for text in wanted)
    development = needed(document["dependency-groups"]["dev"])
    only_extras = {name: one for name, one in extras.items() if name not in base}
    only_development = {
        name: one for name, one in development.items() if name not in base and name not in extras
    }
    lines = [
        "# Licences of what derender needs",
        "",
        "derender itself is under the MIT licence (`LICENSE`). This page is written by",
        "`python tests/trust/licences.py` from the metadata of the packages that are installed; the versions",
        "are those of `constraints.txt`. None of these packages is part of derender's own files.",
        "",
        "Two packages bring programs or libraries with a licence of their own: the wheel of imageio-ffmpeg",
        "holds an ffmpeg program under the GNU General Public License (`ffmpeg -L` tells its version), which",
        "derender starts to write MP4 films; and the torch package for NVIDIA GPUs brings NVIDIA's libraries",
        "under NVIDIA's terms.",
        "",
        "## Always needed, with what that needs in turn",
        "",
        *table(rows(base)),
        "",
        "## Needed by an extra (`pip install 'derender[view]'` and others)",
        "",
        *table(rows(only_extras)),
        "",
        "## For development only",
        "",
        *table(rows(only_development)),
        "",
    ]
    return "\n".join(lines)


if __name__ == "__main__":
    PAGE.write_text(page())
