"""Every reader, with whole files to start from, and what it may refuse an input with."""

import io
import json
import os
import warnings
import zipfile
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from fuzzing.inputs import (
    WORDS,
    bytes_like,
    encoded_pictures,
    json_text,
    overrides,
    packed,
    tarred,
)
from hypothesis import strategies as st

import derender
from derender.data import checked_footer, decode, open_source, quiet_pillow, read_images
from derender.data.cache import cache_file, read_cache
from derender.evaluation.memory import Memory
from derender.features import FeatureTable
from derender.storage.atomic import CHECKSUMS, DamageNoticed
from derender.training import resolve
from derender.training.checkpoint import TrainState, load_checkpoint, save_checkpoint
from derender.training.config import config_from_tree, to_yaml
from derender.training.run_folder import read_config_tree, read_metrics
from derender.training.watch import Watcher

REFUSALS = (ValueError, OSError)
TEXT = partial(str, encoding="utf-8", errors="surrogateescape")
TINY = ("image_size=32", "width=4", "light_width=4")


@dataclass(frozen=True)
class Target:
    """A reader and what it is fed.

    Attributes:
        name: of the reader.
        share: of all inputs.
        inputs: how inputs are made.
        read: gives one to the reader.
        wholes: good files, as bytes, for a search that starts from them; none where it is not fed bytes.
        given: makes an input of bytes.
    """

    name: str
    share: float
    inputs: st.SearchStrategy[Any]
    read: Callable[[Any], object]
    wholes: Sequence[bytes] = ()
    given: Callable[[bytes], Any] = bytes


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
    yield Target("config (YAML)", 0.02, documents, config_text, [to_yaml(config).encode()], TEXT)
    yield Target(
        "config (--set)",
        0.28,
        overrides(),
        lambda chosen: resolve("small", chosen),
        ["\0".join(TINY).encode(), b"optimiser.betas=[0.9, 0.99]\0objective.perceptual=none"],
        lambda content: TEXT(content).split("\0"),
    )

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

    written = table.read_bytes()
    yield Target("FeatureTable (parquet)", 0.25, bytes_like(written), table_bytes, [written])
    footer = written[-8 - int.from_bytes(written[-8:-4], "little") : -8]

    def footer_bytes(content: bytes) -> None:
        whole = b"".join((written[: -8 - len(footer)], content, len(content).to_bytes(4, "little"), b"PAR1"))
        checked_footer(io.BytesIO(whole), len(whole))

    yield Target("footer (parquet)", 0.02, bytes_like(footer), footer_bytes, [footer])

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
    yield Target(
        "model (JSON)", 0.03, json_text(described), model_config, [json.dumps(described).encode()], TEXT
    )
    yield Target(
        "model (safetensors)",
        0.01,
        bytes_like(header).map(lambda head: head + weights[len(header) :]) | bytes_like(weights),
        model_weights,
        [header],
        lambda head: head + weights[len(header) :],
    )

    torch.manual_seed(0)
    net = torch.nn.Linear(3, 2)
    optimiser = torch.optim.Adam(net.parameters(), fused=True)
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
        state = load_checkpoint(kept, net, optimiser)
        Watcher.remembering(config.model.ranges, config.batch_size, state.watcher)
        optimiser.step()  # with what was read

    change = st.sampled_from(sorted(files)).flatmap(
        lambda name: st.tuples(st.just(name), bytes_like(files[name]), st.booleans())
    )
    names = sorted(files)

    def of_a_checkpoint(content: bytes) -> tuple[str, bytes, bool]:
        """The first byte chooses a file, which stands without a checksum that would end the search."""
        name = names[content[0] % len(names)] if content else names[0]
        return name, content[1:], name == CHECKSUMS

    yield Target(
        "checkpoint",
        0.04,
        change,
        checkpoint,
        [bytes([number]) + files[name] for number, name in enumerate(names)],
        of_a_checkpoint,
    )

    archive = place / "a.zip"

    def zip_bytes(content: bytes) -> None:
        archive.write_bytes(content)
        with open_source(archive) as source:
            for file in source.files:
                try:
                    source.read(file)
                except REFUSALS:
                    continue

    kinds = (zipfile.ZIP_DEFLATED, zipfile.ZIP_STORED, zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA)
    zips = [packed(kind) for kind in kinds]
    yield Target("zip", 0.14, bytes_like(*zips), zip_bytes, zips)

    def data_set(content: bytes) -> None:
        archive.write_bytes(content)
        read_images(archive, 8, workers=1)

    yield Target("data set in a zip", 0.005, bytes_like(zips[0]), data_set, zips[:1])

    shard = place / "s.tar"

    def shard_bytes(content: bytes) -> None:
        shard.write_bytes(content)
        read_images(shard, 8, workers=1, cache=place / "cache")

    yield Target("data set in a tar shard", 0.005, bytes_like(tarred()), shard_bytes, [tarred()])

    def picture(content: bytes) -> None:
        with quiet_pillow():
            decode(content, 8)

    yield Target("picture", 0.16, bytes_like(*encoded_pictures()), picture)

    memory = Memory(place / "memory")
    memory.recall("kind", {"a": 1}, lambda: {"found": np.arange(6.0)})
    (remembered,) = (place / "memory").iterdir()

    def memory_bytes(content: bytes) -> None:
        remembered.write_bytes(content)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", DamageNoticed)
            assert memory.recall("kind", {"a": 1}, lambda: {"found": np.zeros(2)})

    kept_results = remembered.read_bytes()
    yield Target("remembered results (npz)", 0.02, bytes_like(kept_results), memory_bytes, [kept_results])

    pictures = place / "pictures"
    pictures.mkdir()
    for number, content in enumerate(encoded_pictures()[:2]):
        (pictures / f"{number}.png").write_bytes(content)
        os.utime(pictures / f"{number}.png", (0, 0))
    read_images(pictures, 8, cache=place / "rows", workers=1)
    (rows,) = (place / "rows").iterdir()
    assert cache_file(place / "rows", "pictures", ("x",)).parent == rows.parent

    def rows_bytes(content: bytes) -> None:
        rows.write_bytes(content)
        read_cache(rows, "fingerprint", 8)
        read_images(pictures, 8, cache=place / "rows", workers=1)

    cached = rows.read_bytes()
    yield Target("decoded images (cache)", 0.005, bytes_like(cached), rows_bytes, [cached])

    def metrics(content: bytes) -> None:
        (place / "metrics.jsonl").write_bytes(content)
        read_metrics(place)

    lines = b'{"kind": "train", "images": 8, "l1": 0.1}\n{"kind": "validation", "images": 8}\n'
    yield Target("metrics of a run", 0.015, bytes_like(lines), metrics, [lines])
