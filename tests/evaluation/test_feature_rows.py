"""Tables that do not belong together are refused; labels, tracks and classes are chosen once for all."""

import numpy as np
import pytest

from derender.evaluation.feature_rows import FeatureRow, prepare
from derender.evaluation.options import Options
from derender.features import FeatureTable

WHO = np.array(["ann", "ann", "bob", "bob", "bob", ""])
TRACK = np.array(["1", "1", "2", "3", "3", "3"])


def table(files="abcdef", dimensions=2, seed=0, labels=None, **origin) -> FeatureTable:
    values = np.random.default_rng(seed).normal(size=(len(files), dimensions))
    labels = {"who": WHO[: len(files)], "track": TRACK[: len(files)]} if labels is None else labels
    return FeatureTable(tuple(files), {"geometry": values, "light": values[:, :1]}, labels, origin)


def row(name: str, *tables: FeatureTable, factors=("geometry",), control=False) -> FeatureRow:
    return FeatureRow(name, tables, factors, control)


def test_features_labels_and_controls_are_handed_on():
    rows = [row("ours", table()), row("pixels", table(seed=1), table(seed=2), factors=None, control=True)]
    ready = prepare(rows, ("who",))
    assert [len(arrays) for arrays in ready.features.values()] == [1, 2]
    assert ready.features["pixels"][0].shape == (6, 3) and ready.controls == ("pixels",)
    assert Options(factors="geometry").chosen == ("geometry",)
    np.testing.assert_array_equal(ready.labels["who"], WHO)
    np.testing.assert_array_equal(ready.table.label("track"), TRACK)


def test_tracks_are_averaged_in_every_row_by_the_first_rows_labels():
    other = table(seed=1, labels={})
    ready = prepare([row("ours", table()), row("other", other)], ("who",), mean_by=("who", "track"))
    assert ready.labels["who"].tolist() == ["ann", "bob", "bob"] and ready.n_dropped == 1
    values = other.factors["geometry"]
    expected = np.stack([values[:2].mean(0), values[2], values[3:5].mean(0)])
    np.testing.assert_allclose(ready.features["other"][0], expected, rtol=1e-6)
    with pytest.raises(ValueError, match="label 'track' differs inside groups of who: average by it too"):
        prepare([row("ours", table())], ("track",), mean_by=("who",))


def test_classes_are_chosen_by_size():
    ready = prepare([row("ours", table())], ("who",), min_count=3, max_count=2)
    assert ready.labels["who"].tolist() == ["bob", "bob", ""] and ready.table.files == ("c", "d", "f")
    with pytest.raises(ValueError, match="go with one label, not with 2"):
        prepare([row("ours", table())], ("who", "track"), min_count=2)


@pytest.mark.parametrize(
    ("rows", "message"),
    [
        ([], "at least one feature table"),
        ([row("a", table()), row("a", table())], "two rows have the name 'a'"),
        ([row("a", table()), row("b", table("abc"))], "'a' have 6 rows and 'b' 3: .* same images"),
        ([row("a", table()), row("b", table("abcxyf"))], r"different images, in 2 of 6 rows \(d and x\): em"),
        ([row("a", table(), table(dimensions=3))], "row 'a' mixes features of different models"),
        ([row("a", *(table(settings={"width": n}) for n in (4, 8)))], "'a' mixes .* each model its own name"),
        ([row("a", table(model="SimCLR"), table(model="VQVAE"))], "different models .another kind"),
    ],
)
def test_tables_that_do_not_fit_are_refused(rows, message):
    with pytest.raises(ValueError, match=message):
        prepare(rows, ("who",))
