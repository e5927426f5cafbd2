"""Finds pictures whose decoded pixels are identical. Near-duplicates are another question."""

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Duplicate:
    """A picture with exactly the pixels of an earlier one, at the size both were read in."""

    file: str
    first: str


def pixel_digest(picture: np.ndarray) -> bytes:
    """Sixteen bytes that stand for the picture's pixels."""
    return hashlib.blake2b(picture.data, digest_size=16).digest()


def find_duplicates(files: Sequence[str], digests: Sequence[bytes]) -> tuple[Duplicate, ...]:
    """Every file whose digest an earlier file has already, in order, with that earlier file."""
    first: dict[bytes, str] = {}
    pairs = ((file, first.setdefault(digest, file)) for file, digest in zip(files, digests, strict=True))
    return tuple(Duplicate(file, earlier) for file, earlier in pairs if file != earlier)
