"""The doctor's page tells every finding, escapes what it quotes, and shows the images it names."""

import numpy as np

from derender.data import ImageSet, Skipped
from derender.data.doctor import doctor
from derender.report.doctor import measure_table


def pictures(count: int) -> ImageSet:
    """Noise with one copy, and an unreadable file with a hostile name."""
    images = np.random.default_rng(0).integers(0, 256, (count, 3, 64, 64), dtype=np.uint8)
    images[1] = images[0]
    names = tuple(f"n{number}.png" for number in range(count))
    return ImageSet(images, names, source="made", skipped=(Skipped("<b>x.png", "empty file"),))


def test_the_table_holds_what_was_measured():
    found = doctor(pictures(40))
    values = measure_table(found).values()
    assert found.shared is not None
    assert values["agreement"]["value"] == found.values["agreement"].value
    assert values["agreement"]["±"] == 2 * found.values["agreement"].error
    assert values["distinct images"]["value"] == 39
