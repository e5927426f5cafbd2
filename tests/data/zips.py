"""Archives of every kind that the format allows, and some that it does not."""

import io
import struct
import warnings
import zipfile

PACKINGS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED, zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA)


class Unseekable(io.RawIOBase):
    """A pipe: what is written to it has its sizes behind its bytes."""

    def __init__(self) -> None:
        self.content = bytearray()

    def writable(self) -> bool:
        return True

    def write(self, data) -> int:
        self.content += data
        return len(data)


def packed(
    members: dict[str, bytes], how: int = zipfile.ZIP_DEFLATED, into: io.IOBase | None = None
) -> bytes:
    """A zip of these members."""
    buffer = into or io.BytesIO()
    with warnings.catch_warnings(), zipfile.ZipFile(buffer, "w", how) as archive:
        warnings.simplefilter("ignore", UserWarning)  # names that are there twice
        for name, content in members.items():
            archive.writestr(name, content)
    return bytes(buffer.content) if isinstance(buffer, Unseekable) else buffer.getvalue()


def some(count: int = 5) -> dict[str, bytes]:
    """Members of several lengths, the first of them empty."""
    return {f"folder {row % 2}/{row}.txt": bytes(range(256)) * row for row in range(count)}


def twice(name: str = "a.txt") -> bytes:
    """One name two times."""
    buffer = io.BytesIO()
    with warnings.catch_warnings(), zipfile.ZipFile(buffer, "w") as archive:
        warnings.simplefilter("ignore", UserWarning)
        archive.writestr(name, b"earlier")
        archive.writestr("b.txt", b"between")
        archive.writestr(name, b"later")
    return buffer.getvalue()


def with_comments() -> bytes:
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        for name, content in some().items():
            member = zipfile.ZipInfo(name)
            member.comment, member.extra = b"about PK\1\2 it", struct.pack("<2H4s", 0x7777, 4, b"more")
            archive.writestr(member, content)
        archive.comment = b"about all of it PK\5\7"
    return buffer.getvalue()


def old_names() -> bytes:
    """Names in the code page the format began with, where Python would have written UTF-8."""
    return packed({"AEOE.txt": b"one", "b.txt": b"two"}).replace(b"AEOE.txt", b"\x8e\x94\x99E.txt")


def with_zero_bytes() -> bytes:
    """A name that ends, for those who know, before it ends."""
    return packed({"a.txt-.exe": b"one", "b.txt": b"two"}).replace(b"a.txt-.exe", b"a.txt\0.exe")


def set_in_directory(content: bytes, name: str, at: int, value: bytes) -> bytes:
    """The archive with other bytes at this place of a member's entry in the directory."""
    changed = bytearray(content)
    begin = content.rfind(b"PK\1\2", 0, content.rfind(name.encode()))
    changed[begin + at : begin + at + len(value)] = value
    return bytes(changed)
