"""Dataclasses come back from a memory as they went in; one whose fields have changed is made again."""

from collections.abc import Mapping
from dataclasses import dataclass, fields

import numpy as np
import pytest

from derender.evaluation import GeometryResult, GeometryScores
from derender.evaluation.memory import Memory
from derender.evaluation.memory_values import packed, recall_value, unpacked


@dataclass(frozen=True)
class Inner:
    each: np.ndarray
    names: tuple[str, ...]
    counts: dict[str, int]


@dataclass(frozen=True)
class Outer:
    inner: Inner
    absent: Inner | None
    pair: tuple[float, float] | None
    by_name: Mapping[str, float]
    value: float


def outer(value: float = 0.1) -> Outer:
    inner = Inner(np.array([[1.5, np.nan]], np.float32), ("a", "b"), {"a": 3})
    return Outer(inner, None, (0.25, 1e-17), {"x": float("inf")}, value)


def same(one: object, other: object) -> None:
    assert type(one) is type(other)
    for field in fields(one):  # pyright: ignore[reportArgumentType]
        mine, theirs = getattr(one, field.name), getattr(other, field.name)
        if isinstance(mine, Inner):
            same(mine, theirs)
        elif isinstance(mine, np.ndarray):
            assert mine.dtype == theirs.dtype
            np.testing.assert_array_equal(mine, theirs)
        else:
            assert mine == theirs, field.name


def test_what_was_packed_is_unpacked(tmp_path):
    same(unpacked(Outer, packed(outer())), outer())
    memory = Memory(tmp_path)
    same(recall_value(memory, "outer", {"k": 1}, Outer, outer), outer())
    same(recall_value(memory, "outer", {"k": 1}, Outer, lambda: outer(0.9)), outer())
    assert recall_value(memory, "outer", {"k": 2}, Outer, lambda: outer(0.9)).value == 0.9
    assert (memory.made, memory.recalled) == (2, 1)


def test_numbers_of_numpy_become_numbers():
    made = Outer(outer().inner, None, None, {"x": np.float32(0.5)}, np.float64(0.1))  # type: ignore[arg-type]
    found = unpacked(Outer, packed(made))
    assert found.by_name == {"x": 0.5} and found.value == 0.1 and found.pair is None


def test_a_class_with_other_fields_is_another_result(tmp_path, monkeypatch):
    @dataclass(frozen=True)
    class Grown(Inner):
        more: float = 1.0

    memory = Memory(tmp_path)
    recall_value(memory, "x", {}, Inner, lambda: outer().inner)
    found = recall_value(memory, "x", {}, Grown, lambda: Grown(np.ones(1), (), {}, 2.0))
    assert found.more == 2.0 and memory.made == 2


def test_a_protocols_own_result():
    scores = GeometryScores(0.1, 20.0, 0.9, 1, np.array([0.1, np.nan]), np.array([20.0, np.nan]))
    found = unpacked(GeometryResult, packed(GeometryResult(scores, scores, scores)))
    assert found.untrained is None and found.model.n_empty == 1
    assert found.plane.side_each == pytest.approx([0.1, np.nan], nan_ok=True)
