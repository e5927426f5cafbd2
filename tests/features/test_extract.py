"""Features do not depend on batches, leave the model as it was, and say where they come from."""

import numpy as np
import torch

from derender.features import FeatureTable, embed_image_set, model_fingerprint


def test_features_are_those_of_the_model_whatever_the_batch(model, pictures):
    expected = model.eval().embed(torch.from_numpy(pictures.images).float() / 255)
    for size in (1, 4, 11, 100):
        seen: list[tuple[int, int]] = []
        table = embed_image_set(model, pictures, batch_size=size, progress=lambda *at, to=seen: to.append(at))
        assert seen == [(min(end, 11), 11) for end in range(size, 11 + size, size)]
        for name in expected:
            np.testing.assert_allclose(table.factors[name], expected[name].detach(), rtol=1e-5, atol=1e-5)


def test_labels_partition_and_origin_go_with_the_features(model, pictures, tmp_path):
    table = embed_image_set(model, pictures, origin={"model": "runs/x"})
    assert table.files == pictures.files
    assert table.label("identity").tolist() == pictures.labels["identity"].tolist()
    assert table.label("partition").tolist() == ["train"] * 6 + ["test"] * 5
    assert table.origin["model"] == "runs/x" and table.origin["data"] == "made"
    assert table.origin["weights"] == model_fingerprint(model)
    assert FeatureTable.read(table.write(tmp_path / "t.parquet")).origin == table.origin
