"""Inputs that a reader may meet: whole files changed in a few places, JSON with one value changed, settings.

Leaves out what is read with which (targets.py).
"""

import io
import json
import random
import tarfile
import zipfile
from typing import Any

import numpy as np
import yaml
from hypothesis import strategies as st
from PIL import Image

from derender.overrides import settings_by_name
from derender.training.config import TrainConfig


def mutated(wholes: list[bytes], number: int) -> bytes:
    """One of some whole files, changed in a few places: bits, bytes, runs, numbers, pieces cut or doubled."""
    draw = random.Random(number)
    content = bytearray(draw.choice(wholes))
    for _ in range(draw.choice((1, 1, 1, 2, 3, 8))):
        if not content:
            break
        at, run, size = draw.randrange(len(content)), draw.randrange(1, 64), draw.choice((2, 4, 8))
        all_bits = (1 << 8 * size) - 1
        value = draw.choice((0, 1, all_bits, all_bits // 2, all_bits // 2 + 1))
        changes = [(1, bytes([content[at] ^ 1 << draw.randrange(8)])), (1, draw.randbytes(1))]
        changes += [(4, draw.randbytes(4)), (len(content), b""), (run, b"")]
        changes.append((0, bytes(content[at : at + run])))
        changes.append((size, value.to_bytes(size, draw.choice(("little", "big")))))
        changes.append((16, bytes(len(content[at : at + 16]))))
        length, new = draw.choice(changes)
        content[at : at + length] = new
    return bytes(content)


def bytes_like(*wholes: bytes) -> st.SearchStrategy[bytes]:
    return st.integers(0, 2**63).map(lambda number: mutated(list(wholes), number))


def encoded_pictures() -> list[bytes]:
    """A small image in every format that is read."""
    noise = np.random.default_rng(0).integers(0, 256, (9, 11, 3), dtype=np.uint8)
    picture, deep = Image.fromarray(noise), Image.fromarray(noise[..., 0].astype(np.uint16) * 257)
    plain = [(form, picture) for form in ("JPEG", "PNG", "WEBP", "BMP", "GIF", "TIFF", "PPM")]
    results = []
    for form, one in (*plain, ("PNG", deep), ("TIFF", deep)):
        stream = io.BytesIO()
        more = {"save_all": True, "append_images": [picture.rotate(90)]} if form == "GIF" else {}
        one.save(stream, format=form, **more)
        results.append(stream.getvalue())
    return results


def packed(kind: int) -> bytes:
    """A zip of three images and a list."""
    stream = io.BytesIO()
    members = {f"class {row % 2}/{row}.png": one for row, one in enumerate(encoded_pictures()[:3])}
    members["labels.csv"] = b"file,age\nclass 0/0.png,3\nclass 1/1.png,4\n"
    with zipfile.ZipFile(stream, "w", kind) as archive:
        for name, content in members.items():
            member = zipfile.ZipInfo(name)  # of 1980, whenever it is made
            member.external_attr = 0o600 << 16
            archive.writestr(member, content, compress_type=kind)
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


EIGHTFOLD = [f"&{b} [{', '.join(['*' + a] * 8)}]" for a, b in zip("abcdefghi", "bcdefghij", strict=True)]
LAUGHS = f"[&a [x,x,x,x,x,x,x,x], {', '.join(EIGHTFOLD)}]"
"""A line of YAML that stands for a billion words."""

ENDS = st.none() | st.booleans() | st.integers() | st.floats()
PLAIN = st.recursive(
    ENDS | st.text(max_size=8) | st.binary(max_size=3).map(repr),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=6), inner, max_size=3),
    max_leaves=6,
)
WORDS = st.sampled_from(
    [
        *("1e400", "-0", ".inf", ".nan", "0x7fffffffffffffffffff", "1_000", "1e9999999", "1:30"),
        *("!!python/none", "!!binary aGk=", "&a [*a]", "*a", "<<: 3"),
        *("{", "[[", "'", "\0", "~", "yes", "1:30"),
        *("[" * 500, "- " * 500, LAUGHS),  # reading takes the square of the depth
    ]
)


def json_text(whole: Any) -> st.SearchStrategy[str]:
    """A JSON document with one value, key or piece of text changed."""

    def change(number: int, value: Any) -> str:
        draw = random.Random(number)
        tree = json.loads(json.dumps(whole))
        node, parent, key = tree, None, None
        while isinstance(node, dict | list) and node and (parent is None or draw.random() < 0.7):
            parent, key = node, draw.choice(list(node) if isinstance(node, dict) else range(len(node)))
            node = node[key]
        if parent is None or draw.random() < 0.05:
            return json.dumps(value)
        if draw.random() < 0.15:
            del parent[key]
        else:
            parent[key] = value
        text = json.dumps(tree)
        broken = mutated([text.encode()], number).decode("utf-8", "surrogateescape")
        return text if draw.random() < 0.7 else broken

    return st.builds(change, st.integers(0, 2**62), PLAIN)


def overrides() -> st.SearchStrategy[list[str]]:
    """Settings as ``--set`` takes them; three names of four are known, half of the values small."""
    known = st.sampled_from(list(settings_by_name(TrainConfig().model_dump(mode="json"))))
    parts = st.sampled_from(["model", "objective", "optimiser", "", ".", "a.b.c", "betas.0"])
    small = st.sampled_from(["0", "1", "2", "0.5", "1e-4", "true", "none", "light", "[0.8, 0.1, 0.1]"])
    tree = PLAIN.map(lambda one: yaml.safe_dump(one, default_flow_style=True, width=10**6).strip())
    key = known | known | known | parts | st.text(max_size=12)
    value = small | small | WORDS | tree | st.text(max_size=20)
    mark = st.sampled_from(["=", "=", "=", "", "=="])
    one = st.builds(lambda name, text, between: f"{name}{between}{text}", key, value, mark)
    return st.lists(one, min_size=1, max_size=3)
