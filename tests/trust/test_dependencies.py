"""Dependencies: advisories answered, licences listed, lower bounds pinned, tested versions not below them."""

import re
import tomllib

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name
from packaging.version import Version
from tests.trust import advisories, licences

ROOT = advisories.ROOT
BOUNDS = advisories.lower_bounds()
_, FOUND = advisories.looked_up()
JUDGED = advisories.versions()


def test_every_package_was_looked_up_and_no_other_stands_there():
    assert not JUDGED.keys() - FOUND.keys(), "look these up and write them into tests/trust/advisories.yaml"


def test_what_an_advisory_reaches_is_answered():
    unanswered = [
        f"{name} {version} ({kind}): {one.id}, fixed in {one.fixed}"
        for name, kinds in JUDGED.items()
        for kind, version in kinds.items()
        for one in FOUND[name].reaching(version)
        if not FOUND[name].answer
    ]
    assert not unanswered, "raise the version, or write an answer into tests/trust/advisories.yaml"


def test_answers_are_of_packages_that_need_one():
    answered = {name: one for name, one in FOUND.items() if one.answer}
    needless = [name for name, one in answered.items() if not any(map(one.reaching, JUDGED[name].values()))]
    assert not needless


def test_an_old_pin_would_be_found():
    ids = {one.id for one in FOUND["pillow"].reaching(Version("12.2.0"))}
    assert "CVE-2026-112398" in ids and "CVE-2026-42308" not in ids
    assert not FOUND["pillow"].reaching(JUDGED["pillow"]["tested"])


def test_the_page_has_every_package():
    page = advisories.page()
    assert all(re.search(rf"^\| {re.escape(name)} \|", page, re.MULTILINE) for name in JUDGED)


def test_every_package_that_is_asked_for_has_a_licence():
    groups = tomllib.loads((ROOT / "pyproject.toml").read_text())["dependency-groups"]
    listed = dict(re.findall(r"^\| \[?([\w.-]+).* \| (.+) \|$", licences.page(), re.MULTILINE))
    names = {*BOUNDS, *(canonicalize_name(Requirement(text).name) for text in groups["dev"])}
    assert names - listed.keys() <= {"standard-imghdr"}  # needed from Python 3.13 on only
    assert all(licence.strip() for licence in listed.values())


def test_every_lower_bound_is_pinned_as_it_stands():
    lowest = advisories.pins(ROOT / "constraints-lowest.txt")
    for name, bound in BOUNDS.items():
        assert lowest[name] == bound, f"{name}: {lowest[name]} is not the bound {bound}"


def test_nothing_is_tested_below_its_bound():
    newest = advisories.pins(ROOT / "constraints.txt")
    there = BOUNDS.keys() & newest.keys()
    assert len(there) > 20
    for name in there:
        assert newest[name] >= BOUNDS[name], name
