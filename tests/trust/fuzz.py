"""Feeds broken configurations, tables, models, checkpoints, caches, archives and pictures to their readers.

    python tests/trust/fuzz.py --inputs 100000 --seed 0

A reader may refuse an input with ValueError or OSError, which the command line tells in one line; anything
else that escapes, an input that takes longer than ``SLOW_SECONDS``, and one that makes the process ask for
``LARGE_BYTES`` more than before, is a finding. The whole process may take ``ADDRESS_BYTES``. Each kind of
finding is told once, with the number of the input, from which the same seed makes it again.
"""

import argparse
import io
import json
import random
import resource
import sys
import tarfile
import tempfile
import time
import traceback
import warnings
import zipfile
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
import yaml
from hypothesis import HealthCheck, Phase, given, seed, settings
from hypothesis import strategies as st
from PIL import Image

import derender
from derender.data import read_pictures
from derender.data.cache import cache_file, read_cache
from derender.data.decode import decode, quiet_pillow
from derender.data.source import open_source
from derender.evaluation.memory import Memory
from derender.features import FeatureTable
from derender.training import resolve
from derender.training.checkpoint import TrainState, load_checkpoint, save_checkpoint
from derender.training.config import config_from_tree, setting_names, to_yaml
from derender.training.run_folder import read_config_tree, read_metrics
from derender.whole import CHECKSUMS

REFUSALS = (ValueError, OSError)
SLOW_SECONDS = 5.0
LARGE_BYTES = 2**30
ADDRESS_BYTES = 14 * 2**30  # a page may claim 2 GiB, which is reserved, not used; torch maps a few by itself
TINY = ("image_size=32", "width=4", "light_width=4")


@dataclass(frozen=True)
class Target:
    """A reader and what it is fed.

    Attributes:
        name: of the reader.
        share: of all inputs.
        inputs: how inputs are made.
        read: gives one to the reader.
    """

    name: str
    share: float
    inputs: st.SearchStrategy[Any]
    read: Callable[[Any], object]


@dataclass
class Found:
    """What came of one target: inputs, how many were accepted, findings by kind with an example."""

    inputs: int = 0
    accepted: int = 0
    slowest: float = 0.0
    findings: dict[str, str] = field(default_factory=dict)
    times: Counter[str] = field(default_factory=Counter)


def mutated(wholes: list[bytes], number: int) -> bytes:
    """One of some whole files, changed in a few places: bits, bytes, runs, numbers, pieces cut or doubled."""
    numbers = random.Random(number)
    content = bytearray(numbers.choice(wholes))
    for _ in range(numbers.choice((1, 1, 1, 2, 3, 8))):
        if not content:
            break
        at = numbers.randrange(len(content))
        match numbers.randrange(8):
            case 0:
                content[at] ^= 1 << numbers.randrange(8)
            case 1:
                content[at] = numbers.randrange(256)
            case 2:
                del content[at:]
            case 3:
                del content[at : at + numbers.randrange(1, 64)]
            case 4:
                content[at:at] = content[at : at + numbers.randrange(1, 64)]
            case 5:
                size = numbers.choice((2, 4, 8))
                value = numbers.choice(
                    (0, 1, (1 << 8 * size) - 1, 1 << (8 * size - 1), (1 << 8 * size - 1) - 1)
                )
                content[at : at + size] = value.to_bytes(size, numbers.choice(("little", "big")))
            case 6:
                content[at : at + 16] = bytes(len(content[at : at + 16]))
            case 7:
                content[at : at + 4] = numbers.randbytes(4)
    return bytes(content)


def bytes_like(*wholes: bytes) -> st.SearchStrategy[bytes]:
    return st.integers(0, 2**63).map(lambda number: mutated(list(wholes), number))


def encoded_pictures() -> list[bytes]:
    """A small picture in every format that is read."""
    noise = np.random.default_rng(0).integers(0, 256, (9, 11, 3), dtype=np.uint8)
    picture, deep = Image.fromarray(noise), Image.fromarray(noise[..., 0].astype(np.uint16) * 257)
    found = []
    for form, one in (
        *((form, picture) for form in ("JPEG", "PNG", "WEBP", "BMP", "GIF", "TIFF", "PPM")),
        ("PNG", deep),
        ("TIFF", deep),
    ):
        stream = io.BytesIO()
        one.save(
            stream,
            format=form,
            **({"save_all": True, "append_images": [picture.rotate(90)]} if form == "GIF" else {}),
        )
        found.append(stream.getvalue())
    return found


def packed(kind: int) -> bytes:
    """A zip of three pictures and a list."""
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", kind) as archive:
        for number, picture in enumerate(encoded_pictures()[:3]):
            archive.writestr(f"class {number % 2}/{number}.png", picture)
        archive.writestr("labels.csv", "file,age\nclass 0/0.png,3\nclass 1/1.png,4\n")
    return stream.getvalue()


def tarred() -> bytes:
    """A shard of two samples."""
    stream = io.BytesIO()
    with tarfile.open(fileobj=stream, mode="w") as tar:
        for number, picture in enumerate(encoded_pictures()[:2]):
            for name, content in ((f"{number}.png", picture), (f"{number}.json", b'{"age": 3}')):
                entry = tarfile.TarInfo(name)
                entry.size = len(content)
                tar.addfile(entry, io.BytesIO(content))
    return stream.getvalue()


LAUGHS = (
    "[&a [x,x,x,x,x,x,x,x], "
    + ", ".join(f"&{b} [{', '.join(['*' + a] * 8)}]" for a, b in zip("abcdefghi", "bcdefghij", strict=True))
    + "]"
)
"""A line of YAML that stands for a billion words."""

PLAIN = st.recursive(
    st.none()
    | st.booleans()
    | st.integers()
    | st.floats()
    | st.text(max_size=8)
    | st.binary(max_size=3).map(repr),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=6), inner, max_size=3),
    max_leaves=6,
)
WORDS = st.sampled_from(
    [
        "1e400",
        "-0",
        ".inf",
        ".nan",
        "0x7fffffffffffffffffff",
        "1_000",
        "2026-01-01",
        "!!python/none",
        "&a [*a]",
        "*a",
        "<<: 3",
        "{",
        "[[",
        "'",
        "\0",
        "~",
        "yes",
        "1:30",
        "!!binary aGk=",
        "1e9999999",
        "[" * 2000,
        "- " * 500,
        LAUGHS,
    ]
)


def json_text(whole: Any) -> st.SearchStrategy[str]:
    """A JSON document with one value, key or piece of text changed."""

    def change(number: int, value: Any) -> str:
        numbers = random.Random(number)
        tree = json.loads(json.dumps(whole))
        node, parent, key = tree, None, None
        while isinstance(node, dict | list) and node and (parent is None or numbers.random() < 0.7):
            parent, key = node, numbers.choice(list(node) if isinstance(node, dict) else range(len(node)))
            node = node[key]
        if parent is None or numbers.random() < 0.05:
            return json.dumps(value)
        if numbers.random() < 0.15:
            del parent[key]
        else:
            parent[key] = value
        text = json.dumps(tree)
        return (
            text
            if numbers.random() < 0.7
            else mutated([text.encode()], number).decode("utf-8", "surrogateescape")
        )

    return st.builds(change, st.integers(0, 2**62), PLAIN)


def overrides() -> st.SearchStrategy[list[str]]:
    """Settings as ``--set`` takes them."""
    key = (
        st.sampled_from(setting_names())
        | st.sampled_from(setting_names())
        | st.sampled_from(setting_names())
        | st.sampled_from(["model", "objective", "optimiser", "", ".", "a.b.c", "betas.0"])
        | st.text(max_size=12)
    )
    small = st.sampled_from(
        ["0", "1", "2", "0.5", "1e-4", "true", "false", "none", "light", "[0.8, 0.1, 0.1]"]
    )
    value = (
        small
        | small
        | WORDS
        | PLAIN.map(lambda tree: yaml.safe_dump(tree, default_flow_style=True, width=10**6).strip())
        | st.text(max_size=20)
    )
    one = st.builds(
        lambda name, text, mark: f"{name}{mark}{text}", key, value, st.sampled_from(["=", "=", "=", "", "=="])
    )
    return st.lists(one, min_size=1, max_size=3)


def targets(place: Path) -> Iterator[Target]:
    """Every reader, with whole files to start from."""
    numbers = np.random.default_rng(0)
    config = resolve("small", TINY)
    tree = config.model_dump(mode="json")

    def config_text(text: str) -> None:
        (place / "config.yaml").write_text(text, errors="surrogateescape")
        config_from_tree(read_config_tree(place))

    documents = (
        json_text(tree)
        | bytes_like(to_yaml(config).encode()).map(lambda content: content.decode("utf-8", "surrogateescape"))
        | WORDS.map(lambda word: f"preset: {word}\n")
    )
    yield Target("config (YAML)", 0.02, documents, config_text)
    yield Target("config (--set)", 0.3, overrides(), lambda chosen: resolve("small", chosen))

    table = place / "F.parquet"
    FeatureTable(
        ("a", "b", "c"),
        {"geometry": numbers.normal(size=(3, 4)), "light": numbers.normal(size=(3, 2))},
        {"age": np.array([1.0, 2, 3]), "name": np.array(["x", "y", "z"])},
        {"data": "here"},
    ).write(table)

    def table_bytes(content: bytes) -> None:
        table.write_bytes(content)
        FeatureTable.read(table)

    yield Target("FeatureTable (parquet)", 0.25, bytes_like(table.read_bytes()), table_bytes)

    model = derender.Derenderer.seeded(config.model, 0)
    folder = model.save(place / "model")
    described, weights = (
        json.loads((folder / "config.json").read_text()),
        (folder / "model.safetensors").read_bytes(),
    )

    def model_config(text: str) -> None:
        (folder / "config.json").write_text(text, errors="surrogateescape")
        (folder / "model.safetensors").write_bytes(weights)
        derender.load(folder)

    def model_weights(content: bytes) -> None:
        (folder / "config.json").write_text(json.dumps(described))
        (folder / "model.safetensors").write_bytes(content)
        derender.load(folder)

    header = weights[: 8 + int.from_bytes(weights[:8], "little")]
    yield Target("model (JSON)", 0.03, json_text(described), model_config)
    yield Target(
        "model (safetensors)",
        0.01,
        bytes_like(header).map(lambda head: head + weights[len(header) :]) | bytes_like(weights),
        model_weights,
    )

    net = torch.nn.Linear(3, 2)
    optimiser = torch.optim.Adam(net.parameters())
    net(torch.ones(1, 3)).sum().backward()
    optimiser.step()
    kept = place / "last"
    save_checkpoint(kept, net, optimiser, TrainState(images=8))
    files = {file.name: file.read_bytes() for file in kept.iterdir()}

    def checkpoint(change: tuple[str, bytes, bool]) -> None:
        name, content, sealed = change
        for other, whole in files.items():
            (kept / other).write_bytes(whole)
        (kept / name).write_bytes(content)
        if not sealed:  # as earlier versions wrote them
            (kept / CHECKSUMS).unlink()
            state = (kept / "state.json").read_bytes()
            (kept / "state.json").write_bytes(state.replace(b'"format": 1, ', b""))
        load_checkpoint(kept, net, optimiser)

    change = st.sampled_from(sorted(files)).flatmap(
        lambda name: st.tuples(st.just(name), bytes_like(files[name]), st.booleans())
    )
    yield Target("checkpoint", 0.04, change, checkpoint)

    archive = place / "a.zip"

    def zip_bytes(content: bytes) -> None:
        archive.write_bytes(content)
        with open_source(archive) as source:
            for file in source.files:
                try:
                    source.read(file)
                except REFUSALS:
                    continue

    yield Target(
        "zip",
        0.14,
        bytes_like(
            packed(zipfile.ZIP_DEFLATED),
            packed(zipfile.ZIP_STORED),
            packed(zipfile.ZIP_BZIP2),
            packed(zipfile.ZIP_LZMA),
        ),
        zip_bytes,
    )

    def data_set(content: bytes) -> None:
        archive.write_bytes(content)
        read_pictures(archive, 8, workers=1)

    yield Target("data set in a zip", 0.005, bytes_like(packed(zipfile.ZIP_DEFLATED)), data_set)

    shard = place / "s.tar"

    def shard_bytes(content: bytes) -> None:
        shard.write_bytes(content)
        read_pictures(shard, 8, workers=1, cache=place / "cache")

    yield Target("data set in a tar shard", 0.005, bytes_like(tarred()), shard_bytes)

    def picture(content: bytes) -> None:
        with quiet_pillow():
            decode(content, 8)

    yield Target("picture", 0.16, bytes_like(*encoded_pictures()), picture)

    memory = Memory(place / "memory")
    memory.recall("kind", {"a": 1}, lambda: {"found": np.arange(6.0)})
    (remembered,) = (place / "memory").iterdir()

    def memory_bytes(content: bytes) -> None:
        remembered.write_bytes(content)
        assert memory.recall("kind", {"a": 1}, lambda: {"found": np.zeros(2)})

    yield Target("remembered results (npz)", 0.02, bytes_like(remembered.read_bytes()), memory_bytes)

    pictures = place / "pictures"
    pictures.mkdir()
    for number, content in enumerate(encoded_pictures()[:2]):
        (pictures / f"{number}.png").write_bytes(content)
    read_pictures(pictures, 8, cache=place / "rows", workers=1)
    (rows,) = (place / "rows").iterdir()
    assert cache_file(place / "rows", "pictures", ("x",)).parent == rows.parent

    def rows_bytes(content: bytes) -> None:
        rows.write_bytes(content)
        read_cache(rows, "fingerprint", 8)
        read_pictures(pictures, 8, cache=place / "rows", workers=1)

    yield Target("decoded pictures (cache)", 0.005, bytes_like(rows.read_bytes()), rows_bytes)

    def metrics(content: bytes) -> None:
        (place / "metrics.jsonl").write_bytes(content)
        read_metrics(place)

    lines = b'{"kind": "train", "images": 8, "l1": 0.1}\n{"kind": "validation", "images": 8}\n'
    yield Target("metrics of a run", 0.015, bytes_like(lines), metrics)


def fuzz(target: Target, inputs: int, number: int) -> Found:
    """Feed a reader so many inputs; what it refuses is counted, what escapes is kept."""
    found = Found()

    def one(value: Any) -> None:
        found.inputs += 1
        before = peak_bytes()
        began = time.process_time()
        try:
            target.read(value)
            found.accepted += 1
        except REFUSALS as refused:
            if isinstance(refused.__cause__, MemoryError):
                found.times["memory"] += 1
                found.findings.setdefault("memory", f"{refused.__cause__} <- {value!r:.300}")
        except Exception as escaped:
            where = traceback.extract_tb(escaped.__traceback__)
            ours = [
                frame for frame in where if "derender" in frame.filename and "trust" not in frame.filename
            ]
            frame = (ours or where)[-1]
            kind = f"{type(escaped).__name__} at {Path(frame.filename).name}:{frame.lineno}"
            found.times[kind] += 1
            found.findings.setdefault(kind, f"{' '.join(str(escaped).split())[:200]} <- {value!r:.300}")
        if peak_bytes() - before > LARGE_BYTES:
            found.times["large"] += 1
            found.findings.setdefault("large", f"{peak_bytes() - before:,} bytes more <- {value!r:.300}")
        took = time.process_time() - began
        found.slowest = max(found.slowest, took)

    chosen = settings(
        max_examples=inputs,
        deadline=None,
        database=None,
        phases=[Phase.generate],
        suppress_health_check=list(HealthCheck),
    )
    seed(number)(chosen(given(target.inputs)(one)))()
    if found.slowest > SLOW_SECONDS:
        found.findings["slow"] = f"one input took {found.slowest:.1f} s of processor time"
    return found


def peak_bytes() -> int:
    """The most memory that this process has held so far."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024


@contextmanager
def quiet() -> Iterator[None]:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        yield


def run(given_: argparse.Namespace) -> int:
    """The script."""
    total = findings = 0
    resource.setrlimit(resource.RLIMIT_AS, (ADDRESS_BYTES, ADDRESS_BYTES))
    with tempfile.TemporaryDirectory() as place, quiet():
        for target in targets(Path(place)):
            if given_.only and given_.only not in target.name:
                continue
            began = time.monotonic()
            found = fuzz(target, max(1, round(given_.inputs * target.share)), given_.seed)
            total, findings = total + found.inputs, findings + len(found.findings)
            print(
                f"{target.name}: {found.inputs:,} inputs, {found.accepted:,} read, "
                f"{len(found.findings)} findings, slowest {found.slowest:.2f} s, "
                f"{time.monotonic() - began:.0f} s in all",
                flush=True,
            )
            for kind, example in found.findings.items():
                print(f"  {kind} ({found.times[kind]}): {example}", flush=True)
    print(f"{total:,} inputs, {findings} findings")
    return 1 if findings else 0


if __name__ == "__main__":
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--inputs", type=int, default=100_000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", default="", help="targets whose name holds this")
    sys.exit(run(parser.parse_args()))
