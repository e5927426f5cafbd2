"""A tiny model and image set with the interfaces that features need; tables compared."""

import numpy as np
import pytest
import torch
from torch import nn

from derender.data import ImageSet
from derender.features import FeatureTable

SIZE = 8


def assert_same(table: FeatureTable, expected: FeatureTable) -> None:
    """Bit for bit, kinds of columns and their order included."""
    assert table.files == expected.files and table.origin == expected.origin
    assert list(table.factors) == list(expected.factors) and list(table.labels) == list(expected.labels)
    for name, values in {**expected.factors, **expected.labels}.items():
        result = {**table.factors, **table.labels}[name]
        assert result.dtype.kind == values.dtype.kind, name
        np.testing.assert_array_equal(result, values)


class TinyModel(nn.Module):
    """Two factors of 3 and 2 numbers: fixed random projections of the image, one with a BatchNorm."""

    def __init__(self, seed: int = 0):
        super().__init__()
        generator = torch.Generator().manual_seed(seed)
        self.register_buffer("a", torch.randn(3 * SIZE * SIZE, 3, generator=generator))
        self.register_buffer("b", torch.randn(3 * SIZE * SIZE, 2, generator=generator))
        self.norm = nn.BatchNorm1d(3)
        self.image_size = SIZE

    @property
    def device(self) -> torch.device:
        return self.a.device

    def embed(self, images: torch.Tensor) -> dict[str, torch.Tensor]:
        flat = images.flatten(1)
        return {"geometry": self.norm(flat @ self.a), "albedo": flat @ self.b}


@pytest.fixture
def model() -> TinyModel:
    return TinyModel()


@pytest.fixture
def pictures() -> ImageSet:
    images = np.random.default_rng(0).integers(0, 256, (11, 3, SIZE, SIZE), dtype=np.uint8)
    labels = {"identity": np.array(["a", "b", "", "c", "a", "b", "c", "a", "b", "c", "a"])}
    partition = np.array(["train"] * 6 + ["test"] * 5)
    files = tuple(f"{i}.png" for i in range(11))
    return ImageSet(images, files, labels, partition=partition, source="made")
