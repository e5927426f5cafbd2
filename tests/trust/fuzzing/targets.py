"""Every reader, with whole files to start from, and what it may refuse an input with."""

import json
import os
import zipfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import torch
from fuzzing.inputs import WORDS, bytes_like, encoded_pictures, json_text, overrides, packed, tarred
from hypothesis import strategies as st

import derender
from derender.data import decode, open_source, opened_parquet, quiet_pillow, read_images
from derender.data.cache import read_cache
from derender.evaluation.memory import Memory
from derender.features import FeatureTable
from derender.overrides import checked
from derender.storage.atomic import CHECKSUMS
from derender.training import resolve
from derender.training.checkpoint import TrainState, load_checkpoint, save_checkpoint
from derender.training.config import TrainConfig, to_yaml
from derender.training.run_folder import read_config_tree, read_metrics
from derender.training.watch import Watcher

REFUSALS = (ValueError, OSError)
TEXT = partial(str, encoding="utf-8", errors="surrogateescape")
TINY = ("image_size=32", "width=4", "light_width=4")
CONFIG = resolve("small", TINY)


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
        made_again: whether the reader makes a damaged file again instead of refusing it.
    """

    name: str
    share: float
    inputs: st.SearchStrategy[Any]
    read: Callable[[Any], object]
    wholes: Sequence[bytes] = ()
    given: Callable[[bytes], Any] = bytes
    made_again: bool = False


def bytes_target(
    name: str, share: float, file: Path, read: Callable[[], object], *wholes: bytes, **more: bool
) -> Target:
    """A reader of one file, which is fed changed copies of whole ones."""

    def written_and_read(content: bytes) -> None:
        file.write_bytes(content)
        read()

    return Target(name, share, bytes_like(*wholes), written_and_read, wholes, **more)


def targets(place: Path) -> Iterator[Target]:
    """Every reader, with whole files to start from."""
    yield from configurations(place)
    yield from tables(place)
    yield from models(place)
    yield checkpoint_target(place)
    yield from images(place)
    yield from kept_results(place)


def configurations(place: Path) -> Iterator[Target]:
    file, whole = place / "config.yaml", to_yaml(CONFIG).encode()

    def read(text: str) -> None:
        file.write_text(text, errors="surrogateescape")
        checked(read_config_tree(place), TrainConfig)

    documents = json_text(CONFIG.model_dump(mode="json")) | bytes_like(whole).map(TEXT)
    documents |= WORDS.map(lambda word: f"preset: {word}\n")
    yield Target("config (YAML)", 0.02, documents, read, [whole], TEXT)
    chosen = ["\0".join(TINY).encode(), b"optimiser.betas=[0.9, 0.99]\0objective.perceptual=none"]
    yield Target(
        "config (--set)", 0.28, overrides(), partial(resolve, "small"), chosen,
        lambda content: TEXT(content).split("\0"),
    )  # fmt: skip


def tables(place: Path) -> Iterator[Target]:
    draw, file = np.random.default_rng(0), place / "F.parquet"
    factors = {"geometry": draw.normal(size=(3, 4)), "light": draw.normal(size=(3, 2))}
    labels = {"age": np.array([1.0, 2, 3]), "name": np.array(["x", "y", "z"])}
    whole = FeatureTable(("a", "b", "c"), factors, labels, {"data": "here"}).write(file).read_bytes()
    yield bytes_target("FeatureTable (parquet)", 0.25, file, lambda: FeatureTable.read(file), whole)
    footer = whole[-8 - int.from_bytes(whole[-8:-4], "little") : -8]

    def read(content: bytes) -> None:
        end = content + len(content).to_bytes(4, "little") + b"PAR1"
        with suppress(pa.ArrowException):  # as FeatureTable.read does
            opened_parquet(whole[: -8 - len(footer)] + end)

    yield Target("footer (parquet)", 0.02, bytes_like(footer), read, [footer])


def models(place: Path) -> Iterator[Target]:
    folder = derender.Derenderer.seeded(CONFIG.model, 0).save(place / "model")
    described, weights = (folder / "config.json").read_bytes(), (folder / "model.safetensors").read_bytes()

    def read(config: bytes, content: bytes) -> None:
        (folder / "config.json").write_bytes(config)
        (folder / "model.safetensors").write_bytes(content)
        derender.load(folder)

    yield Target(
        "model (JSON)", 0.03, json_text(json.loads(described)),
        lambda text: read(text.encode(errors="surrogateescape"), weights), [described], TEXT,
    )  # fmt: skip
    header = weights[: 8 + int.from_bytes(weights[:8], "little")]

    def with_header(head: bytes) -> bytes:
        return head + weights[len(header) :]

    inputs = bytes_like(header).map(with_header) | bytes_like(weights)
    yield Target("model (safetensors)", 0.01, inputs, partial(read, described), [header], with_header)


def checkpoint_target(place: Path) -> Target:
    torch.manual_seed(0)
    net, kept = torch.nn.Linear(3, 2), place / "last"
    optimiser = torch.optim.Adam(net.parameters(), fused=True)
    net(torch.ones(1, 3)).sum().backward()
    optimiser.step()
    save_checkpoint(kept, net, optimiser, TrainState(images=8))
    files = {file.name: file.read_bytes() for file in sorted(kept.iterdir())}
    names = list(files)

    def read(change: tuple[str, bytes, bool]) -> None:
        name, content, sealed = change
        for other, whole in {**files, name: content}.items():
            (kept / other).write_bytes(whole)
        if not sealed:  # as earlier versions wrote them
            (kept / CHECKSUMS).unlink()
            state = (kept / "state.json").read_bytes()
            (kept / "state.json").write_bytes(state.replace(b'"format": 1, ', b""))
        state = load_checkpoint(kept, net, optimiser)
        Watcher.remembering(CONFIG.model.ranges, CONFIG.batch_size, state.watcher)
        optimiser.step()  # with what was read

    def of_bytes(content: bytes) -> tuple[str, bytes, bool]:
        """The first byte chooses a file, which stands without a checksum that would end the search."""
        name = names[content[0] % len(names)] if content else names[0]
        return name, content[1:], name == CHECKSUMS

    changes = {name: st.tuples(st.just(name), bytes_like(files[name]), st.booleans()) for name in names}
    change = st.sampled_from(names).flatmap(changes.__getitem__)
    wholes = [bytes([number]) + files[name] for number, name in enumerate(names)]
    return Target("checkpoint", 0.04, change, read, wholes, of_bytes)


def images(place: Path) -> Iterator[Target]:
    archive, shard = place / "a.zip", place / "s.tar"

    def read_members() -> None:
        with open_source(archive) as source:
            for file in source.files:
                try:
                    source.read(file)
                except REFUSALS:
                    continue

    zips = [packed(kind) for kind in (zipfile.ZIP_DEFLATED, zipfile.ZIP_STORED)]
    yield bytes_target("zip", 0.14, archive, read_members, *zips)
    whole = partial(read_images, archive, 8, workers=1)
    yield bytes_target("data set in a zip", 0.005, archive, whole, zips[0])
    whole = partial(read_images, shard, 8, workers=1, cache=place / "cache")
    yield bytes_target("data set in a tar shard", 0.005, shard, whole, tarred())

    def picture(content: bytes) -> None:
        with quiet_pillow():
            decode(content, 8)

    yield Target("picture", 0.16, bytes_like(*encoded_pictures()), picture)


def kept_results(place: Path) -> Iterator[Target]:
    memory = Memory(place / "memory")
    memory.recall("kind", {"a": 1}, lambda: {"found": np.arange(6.0)})
    (file,) = (place / "memory").iterdir()

    def recall() -> None:
        assert memory.recall("kind", {"a": 1}, lambda: {"found": np.zeros(2)})

    yield bytes_target("remembered results (npz)", 0.02, file, recall, file.read_bytes(), made_again=True)
    folder = place / "pictures"
    folder.mkdir()
    for number, content in enumerate(encoded_pictures()[:2]):
        (folder / f"{number}.png").write_bytes(content)
        os.utime(folder / f"{number}.png", (0, 0))
    read_images(folder, 8, cache=place / "rows", workers=1)
    (rows,) = (place / "rows").iterdir()

    def read_rows() -> None:
        read_cache(rows, "fingerprint", 8)
        read_images(folder, 8, cache=place / "rows", workers=1)

    yield bytes_target("decoded images (cache)", 0.005, rows, read_rows, rows.read_bytes(), made_again=True)
    lines = b'{"kind": "train", "images": 8, "l1": 0.1}\n{"kind": "validation", "images": 8}\n'
    yield bytes_target("metrics of a run", 0.015, place / "metrics.jsonl", lambda: read_metrics(place), lines)
