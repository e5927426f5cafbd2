"""Good sets are accepted, bad ones objected to for the right reason, with no more certainty than is due."""

from dataclasses import replace

import numpy as np
import pytest
from tests.data.doctor import made

from derender.data import Duplicate, Skipped, read_images
from derender.data.doctor import CHECKS, doctor, judged, quick_verdict
from derender.data.doctor.measures import JackknifeEstimate


def levels(examination) -> dict[str, str]:
    return {finding.name: finding.level for finding in examination.findings}


def test_varied_faces_are_only_few_and_an_examination_can_be_repeated():
    result, again = (doctor(made.as_set(made.generated("faces")), seed=5) for _ in range(2))
    assert result.findings == again.findings and result.examples == again.examples
    assert result.verdict.word == "will struggle"
    assert result.verdict.because == ("108 distinct images are too few",)
    assert {name for name, level in levels(result).items() if level != "good"} == {"number"}
    assert result.mean is not None and result.mean.shape == (3, 64, 64)
    assert len(result.examples["most typical"]) == 8


def test_the_quick_check_of_a_sample_does_not_count_images():
    few = made.generated("faces")
    both = np.concatenate([few, made.generated("one light")])
    many = np.concatenate([both, both[..., ::-1]])
    assert "108 distinct images are too few" in quick_verdict(made.as_set(few))
    assert quick_verdict(made.as_set(many)) == ""


@pytest.mark.parametrize(
    ("kind", "expected"),
    [("landscapes", {"the rest": "open"}), ("noise", {"the rest": "open"}),
     ("moved", {"alignment": "objection"}), ("copies", {"number": "objection", "copies": "trouble"})],
)  # fmt: skip
def test_what_has_no_place_in_the_picture_or_no_variety_is_objected_to(kind, expected, numbers):
    make = getattr(made, kind)
    result = doctor(made.as_set(make(made.generated("faces") if kind == "moved" else 150, numbers)))
    assert result.verdict.word == "does not suit" and expected.items() <= levels(result).items()
    assert kind in ("moved", "copies") or "too little in common" in result.verdict.because[0]


def test_pairs_of_copies_are_shown(numbers):
    result = doctor(made.as_set(made.copies(300, numbers)))
    assert result.values["distinct"].value < 30
    pairs = result.examples["copies, in pairs"]
    assert all(result.group[second] == first for first, second in zip(pairs[::2], pairs[1::2], strict=True))


def test_one_view_and_one_light_are_objected_to_and_one_of_them_is_trouble():
    both = doctor(made.as_set(made.generated("one view and light")))
    assert both.verdict.word == "does not suit"
    assert set(both.verdict.because) == {"all are seen from the same side", "all are lit alike"}
    for kind, name, other in (("one view", "view", "light"), ("one light", "light", "view")):
        result = levels(doctor(made.as_set(made.generated(kind))))
        assert result[name] == "trouble" and result[other] == "good", kind


def test_a_crop_off_the_middle_is_named_with_its_side():
    wide = np.pad(made.generated("faces"), ((0, 0), (0, 0), (0, 0), (8, 8)), mode="edge")
    finding = {f.name: f for f in doctor(made.as_set(wide[..., :64])).findings}["symmetry"]
    assert finding.level == "objection" and "right of the middle" in finding.text
    assert finding.advice == "Crop further to the right, so that the axis is in the middle."


def test_faces_mixed_with_landscapes_show_the_odd_ones(numbers):
    images = np.concatenate([made.generated("faces"), made.landscapes(20, numbers)])
    result = doctor(made.as_set(images))
    assert levels(result)["out-of-distribution"] == "trouble"
    assert all(row >= made.COUNT for row in result.examples["least typical"])


def test_two_kinds_are_objected_to(numbers):
    """Faces, and faces cut in four and put together crosswise: as common a structure at other places."""
    other = np.roll(made.generated("faces"), (32, 32), axis=(2, 3))
    result = doctor(made.as_set(np.concatenate([made.generated("faces"), other])))
    assert levels(result)["kinds"] == "objection"
    assert len(result.examples["one group"]) == len(result.examples["the other group"]) == 8


@pytest.mark.parametrize("count", [1, 2, 23])
def test_few_pictures_are_too_few_and_nothing_is_claimed_of_them(count):
    result = doctor(made.as_set(made.generated("faces")[:count]))
    assert result.verdict.word == "does not suit"
    assert result.shared is None and result.mean is None
    assert levels(result)["the rest"] == "open"
    assert len(result.examples["all distinct"]) == min(count, 8)


def test_an_objection_needs_certainty():
    check, one_sided = (replace(CHECKS["symmetry"], objects=limit, struggles=0.2) for limit in (0.1, None))
    share = replace(one_sided, noted=0.1)
    for value, error, judge, *expected in (
        (0.05, 0.01, check, "objection", True), (0.05, 0.04, check, "trouble", False),
        (0.15, 0.01, check, "trouble", True), (0.15, 0.04, check, "trouble", False),
        (0.25, 0.04, check, "good", False), (0.25, 0.01, check, "good", True),
        (0.05, 0.01, one_sided, "trouble", True), (0.3, 0.01, share, "trouble", True),
        (0.3, 0.06, share, "trouble", False), (0.15, 0.0, share, "note", True),
        (0.15, 0.03, share, "note", False), (0.05, 0.0, share, "good", True),
    ):  # fmt: skip
        assert judged(JackknifeEstimate(value, error), judge) == tuple(expected)


def test_black_white_grey_and_empty_pictures_are_named():
    images = made.generated("faces").copy()
    images[:] = images.mean(axis=1, keepdims=True)
    images[:, :, :, :24] = 255
    images[0] = 7
    result = {finding.name: finding for finding in doctor(made.as_set(images)).findings}
    assert result["colour"].text == "100 % of the images are grey."
    assert result["brightness"].level == "trouble"
    assert "of the images show one brightness only" in result["empty images"].text


def test_unreadable_files_and_copies_to_the_pixel_are_counted():
    images = np.concatenate([made.generated("faces"), made.generated("faces")[:2]])
    skipped = tuple(Skipped(f"{number}.jpg", "empty file") for number in range(60))
    copies = (Duplicate("00108.png", "00000.png"), Duplicate("00109.png", "00001.png"))
    result = doctor(made.as_set(images, skipped=skipped, duplicates=copies))
    by_name = {finding.name: finding for finding in result.findings}
    assert result.identical == 2 and result.as_json()["near_copies"] == 0
    assert by_name["files"].level == "trouble" and repr(result).endswith(result.verdict.text)
    assert "   !  files: 35 % of the files cannot be read." in repr(result)
    assert "2 % of the images are copies or near copies (2 of 110: 2 to the pixel" in by_name["copies"].text


@pytest.mark.parametrize("name", ["utkface64", "lfw64", "celeba64", "synface64", "syncar64"])
def test_the_development_sets_suit_but_for_their_number(name, shared_data):
    path = shared_data(f"data/{name}.zip")
    result = doctor(read_images(path, 64, limit=200, keep_duplicates=True, workers=1))
    assert [f.name for f in result.findings if f.level in ("trouble", "objection")] == ["number"]
