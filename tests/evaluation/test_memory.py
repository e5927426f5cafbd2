"""Cached results are found by content, and only by the same content; dataclasses come back as they were."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import pytest

from derender.evaluation.memory import Memory, content_hash, memory_in, packed, unpacked
from derender.storage.atomic import DamageNoticed


def test_the_same_inputs_are_computed_once(tmp_path):
    calls = []

    def make():
        calls.append(1)
        return {"a": np.arange(3), "b": np.eye(2, dtype=np.float32)}

    memory = Memory(tmp_path)
    for _ in range(2):
        result = memory.recall("tree", {"x": np.ones(4), "k": 3}, make)
        assert result["a"].tolist() == [0, 1, 2] and result["b"].dtype == np.float32
    assert (len(calls), memory.made, memory.recalled) == (1, 1, 1)
    memory.recall("tree", {"x": np.ones(4), "k": 4}, make)
    memory.recall("other", {"x": np.ones(4), "k": 3}, make)
    assert len(calls) == 3 and len(list(tmp_path.iterdir())) == 3


def test_a_damaged_file_is_made_again(tmp_path):
    memory = Memory(tmp_path)
    memory.recall("x", {}, lambda: {"a": np.ones(2)})
    (file,) = tmp_path.iterdir()
    for damaged in (b"", b"nothing", file.read_bytes()[:-30]):
        file.write_bytes(damaged)
        with pytest.warns(DamageNoticed, match="is damaged: computed again"):
            assert Memory(tmp_path).recall("x", {}, lambda: {"a": np.zeros(2)})["a"].tolist() == [0, 0]
        assert Memory(tmp_path).recall("x", {}, dict)["a"].tolist() == [0, 0]


def test_without_a_folder_nothing_is_kept():
    memory = Memory()
    assert [memory.recall("x", {}, lambda: {"a": np.ones(1)})["a"][0] for _ in range(2)] == [1, 1]
    assert (memory.made, memory.recalled) == (2, 0)
    assert memory_in("none").folder is None and memory_in(memory) is memory
    assert memory.summary("runs") == "2 runs computed, 0 found"


ONE = np.array([1.0, 2.0, 3.0])
OTHERS = [np.array([1.0, 2.0, 4.0]), np.array([1, 2, 3]), ONE[None], ONE.astype(np.float32), [1.0, 2.0, 3.0]]


@pytest.mark.parametrize("other", [*({"x": value} for value in OTHERS), {"y": ONE}, {"x": ONE, "k": None}])
def test_every_difference_counts(other):
    assert content_hash({"x": ONE}) != content_hash(other)
    assert content_hash(other) == content_hash(dict(reversed(other.items())))


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
    return Outer(inner, None, (0.25, 1e-17), {"x": float("inf"), "y": np.float32(0.5)}, np.float64(value))


def test_what_was_packed_is_unpacked(tmp_path):
    memory = Memory(tmp_path)
    plain = repr(outer()).replace("np.float32(0.5)", "0.5").replace("np.float64(0.1)", "0.1")
    for again in (unpacked(Outer, packed(outer())), memory.recall_value("outer", {"k": 1}, Outer, outer)):
        assert repr(again) == plain
        assert again.inner.each.dtype == np.float32
    assert memory.recall_value("outer", {"k": 1}, Outer, lambda: outer(0.9)).value == 0.1
    assert memory.recall_value("outer", {"k": 2}, Outer, lambda: outer(0.9)).value == 0.9
    assert (memory.made, memory.recalled) == (2, 1)
