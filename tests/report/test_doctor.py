"""The doctor's page tells every finding, escapes what it quotes, and shows the images it names."""

from dataclasses import replace

import numpy as np

from derender.data import ImageSet, Skipped
from derender.data.doctor import doctor
from derender.report.doctor import doctor_page, measure_table


def pictures(count: int) -> ImageSet:
    """Noise with one copy, and an unreadable file with a hostile name."""
    images = np.random.default_rng(0).integers(0, 256, (count, 3, 64, 64), dtype=np.uint8)
    images[1] = images[0]
    names = tuple(f"n{number}.png" for number in range(count))
    return ImageSet(images, names, source="made", skipped=(Skipped("<b>x.png", "empty file"),))


def test_every_finding_and_the_verdict_are_on_the_page():
    made = pictures(40)
    found = doctor(made)
    html = doctor_page(found).html()
    for finding in found.findings:
        assert f"{finding.name}: " in html and finding.text in html and finding.advice in html
    assert "This set does not suit the method" in html
    assert all(reason in html for reason in found.verdict.because)
    assert "&lt;b&gt;x.png" in html and "<b>x.png" not in html
    assert "n0.png, n1.png" in html, "the copy is shown beside its first"


def test_one_picture_gets_a_page_without_a_mean():
    made = pictures(2)
    one = replace(made.select([0]), skipped=())
    html = doctor_page(doctor(one)).html()
    assert "1 distinct images are too few" in html and "mirrored" not in html
    assert {row.name for row in measure_table(doctor(one)).rows} >= {"distinct images", "copies", "clipped"}


def test_the_table_holds_what_was_measured():
    found = doctor(pictures(40))
    values = measure_table(found).values()
    assert found.shared is not None
    assert values["agreement"]["value"] == found.values["agreement"].value
    assert values["agreement"]["±"] == 2 * found.values["agreement"].error
    assert values["distinct images"]["value"] == 39
