"""The readers on the development data as it is published: counts, labels, copies."""

import numpy as np
import pytest

from derender.data import MASK_CLASSES, list_images, read_masks, split_indices


@pytest.mark.parametrize(
    ("source", "layout", "count", "labels"),
    [
        ("utkface64.zip", "utkface", 21_336, {"age", "gender", "race"}),
        ("lfw64.zip", "lfw", 6_502, {"identity", "emotion"}),
        ("celeba64.zip", "celeba", 7_000, {"Male", "Smiling", "5_o_Clock_Shadow"}),
        ("celebamask128.zip", "celebamask", 800, {"mask"}),
        ("synface64.zip", "synface", 12_000, {"identity", "expression", "light_yaw_rad", "camera_y_rad"}),
        ("synface64.zip::test_gt", "synface", 800, {"identity", "expression", "light_yaw_rad"}),
        ("syncar64.zip", "syncar", 8_000, {"class", "model", "light_pitch_rad"}),
        ("syncar64.zip::test", "syncar", 1_000, {"class", "model"}),
        ("synface_tracks64.zip", "synface_tracks", 1_440, {"identity", "track", "expression"}),
    ],
)
def test_every_archive_is_recognised_and_whole(shared_data, source, layout, count, labels):
    name, _, subset = source.partition("::")
    with list_images(shared_data(f"data/{name}"), subset=subset or None) as listed:
        assert (listed.layout, len(listed.table.files), listed.files.skipped) == (layout, count, ())
        assert labels <= set(listed.table.labels)


def test_people_and_tracks(shared_data):
    with list_images(shared_data("data/lfw64.zip")) as listed:
        labels, files = listed.table.labels, listed.table.files
    _, counts = np.unique(labels["identity"], return_counts=True)
    assert (counts >= 20).sum() == 31 and {"neutral", "happiness"} <= set(labels["emotion"])
    split = split_indices(files, groups=labels["identity"], seed=0)
    assert not set(labels["identity"][split.train]) & set(labels["identity"][split.test])
    with list_images(shared_data("data/synface_tracks64.zip")) as listed:
        labels = listed.table.labels
    assert [len(np.unique(labels[name])) for name in ("identity", "track")] == [12, 240]


def test_celebamask_masks(shared_data):
    """Skin and hair are most of a face's image, the middle of the image is no background."""
    pictures, masks, classes = read_masks(shared_data("data/celebamask128.zip"), 64, limit=100)
    assert (len(pictures), masks.shape, classes) == (100, (100, 64, 64), MASK_CLASSES)
    shares = np.bincount(masks.ravel(), minlength=19) / masks.size
    assert {"background", "skin", "hair"} == {classes[place] for place in np.argsort(shares)[-3:]}
    assert shares.min() > 0 or classes[int(shares.argmin())] in ("neck_l", "hat", "ear_r", "eye_g")
    assert (masks[:, 32, 32] != 0).mean() > 0.95
