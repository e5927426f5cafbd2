"""`derender models`: what is bundled."""

from derender.storage.places import bundled_models


def test_every_bundled_model_is_listed_with_what_it_was_trained_on(numbers):
    rows = numbers("models")[0]["models"]
    assert [row["name"] for row in rows] == list(bundled_models())
    for row in rows:
        assert row["image_size"] == int(row["name"].rsplit("-")[-1]) and 5 < row["megabytes"] < 30
        assert row["about"].startswith("Trained on ") and len(row["about"]) < 90


def test_a_feature_table_in_another_format_is_refused(refused, tmp_path):
    out = tmp_path / "features.csv"
    assert "parquet" in refused("embed", tmp_path, "--model", "faces-64", "--out", out)
    assert not out.exists()
