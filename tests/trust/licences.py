"""Writes licences.md into build/release: every package that derender needs or can use, with its licence.

    python tests/trust/licences.py

Read from what is installed (importlib.metadata): the packages that pyproject.toml names, and those that they
need in turn. Nothing is asked of a network.
"""

import tomllib
from collections.abc import Iterable
from importlib.metadata import Distribution, PackageNotFoundError, distribution
from pathlib import Path

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

ROOT = Path(__file__).resolve().parents[2]
PAGE = ROOT / "build" / "release" / "licences.md"
NAMED = {"BSD License": "BSD", "MIT License": "MIT", "Apache Software License": "Apache-2.0"}
NAMED["Python Software Foundation License"] = "PSF-2.0"
PAGE_HEAD = """\
# Licences of what derender needs

derender itself is under the MIT licence (`LICENSE`). This page is written by
`python tests/trust/licences.py` from the metadata of the packages that are installed; the versions
are those of `constraints.txt`. None of these packages is part of derender's own files.

Two packages bring programs or libraries with a licence of their own: the wheel of imageio-ffmpeg
holds an ffmpeg program under the GNU General Public License (`ffmpeg -L` tells its version), which
derender starts to write MP4 films; and the torch package for NVIDIA GPUs brings NVIDIA's libraries
under NVIDIA's terms.
"""


def needed(requirements: Iterable[str]) -> dict[str, Distribution | None]:
    """The packages that requirements name and those that these need, by name; None: not installed here."""
    result: dict[str, Distribution | None] = {}
    waiting = [(Requirement(text), ("",)) for text in requirements]
    while waiting:
        wanted, extras = waiting.pop()
        name = canonicalize_name(wanted.name)
        applies = wanted.marker is None or any(wanted.marker.evaluate({"extra": one}) for one in extras)
        if not applies or (name in result and not wanted.extras):
            continue
        try:
            result[name] = distribution(name)
        except PackageNotFoundError:
            result[name] = None
            continue
        waiting += [(Requirement(text), ("", *wanted.extras)) for text in result[name].requires or ()]
    return result


def licence_of(package: Distribution) -> str:
    """What a package says of its licence: the expression, the classifiers, or the first line of the field."""
    about = package.metadata
    if about.get("License-Expression"):
        return about["License-Expression"]
    lines = [one for one in about.get_all("Classifier") or () if one.startswith("License")]
    classified = [one.rsplit(" :: ", 1)[-1] for one in lines]
    classified = [NAMED.get(one, one) for one in classified if one != "OSI Approved"]
    stated = (about.get("License") or "not stated").strip().splitlines()
    return ", ".join(dict.fromkeys(classified)) or stated[0][:60]


def home_of(package: Distribution) -> str:
    about = package.metadata
    pairs = (one.partition(", ") for one in about.get_all("Project-URL") or ())
    links = {kind.lower(): link for kind, _, link in pairs}
    kinds = ("homepage", "home", "source", "repository", "source code", "github")
    stated = [about.get("Home-page"), *(links.get(kind) for kind in kinds)]
    return next((one for one in stated if one and one != "UNKNOWN"), "")


def table(result: dict[str, Distribution | None]) -> str:
    lines = ["| package | version | licence |", "| --- | --- | --- |"]
    for name, package in sorted(result.items()):
        if package is None:
            lines.append(f"| {name} |  | not installed where this page was made |")
            continue
        home, licence = home_of(package), licence_of(package).replace("|", "/")
        shown = f"[{name}]({home})" if home.startswith("http") else name
        lines.append(f"| {shown} | {package.version.partition('+')[0]} | {licence} |")
    return "\n".join(lines)


def page() -> str:
    """The whole page."""
    document = tomllib.loads((ROOT / "pyproject.toml").read_text())
    project = document["project"]
    base = needed(project["dependencies"])
    extras = needed(text for wanted in project["optional-dependencies"].values() for text in wanted)
    development = needed(text for group in document["dependency-groups"].values() for text in group)
    only = {name: one for name, one in development.items() if name not in {**base, **extras}}
    extras = {name: one for name, one in extras.items() if name not in base}
    parts = {
        "Always needed, with what that needs in turn": base,
        "Needed by an extra (`pip install 'derender[view]'` and others)": extras,
        "For development only": only,
    }
    return PAGE_HEAD + "".join(f"\n## {title}\n\n{table(result)}\n" for title, result in parts.items())


if __name__ == "__main__":
    PAGE.parent.mkdir(parents=True, exist_ok=True)
    PAGE.write_text(page())
