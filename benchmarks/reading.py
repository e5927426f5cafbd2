"""How long it takes until a very large folder, zip or set of shards is known, at first and later.

Made-up sets of tiny files lie in a temporary folder: a folder of class folders, a zip, tars. A start is what
a command does before the first picture is decoded: list, recognise the layout, read labels, ask every file's
size and time of change (``fingerprint``). The first start has no index to go by, later ones have the
remembered one where there is one. Every start runs in a process of its own; imports are not counted. First it
is shown that an added, a removed and a changed file are seen. Files stay in the system's cache.

    python benchmarks/reading.py --files 200000 --zip 1000000 --shards 200000
"""

import argparse
import io
import json
import os
import subprocess
import sys
import tarfile
import tempfile
import time
import zipfile
from pathlib import Path
from typing import Any

from machine import describe_machine
from PIL import Image

from derender.data.cache import fingerprint
from derender.data.inventory import take_inventory
from derender.data.pictures import read_pictures

CLASSES = 20
SETTLED_SECONDS = 2.5  # what changed a moment ago is never trusted (data/listing.py)


def tiny(number: int) -> bytes:
    """A PNG of 8 x 8 whose pixels are its number, so that none is a copy of another."""
    buffer = io.BytesIO()
    pixels = (number.to_bytes(4, "little") * 48)[:192]
    Image.frombytes("RGB", (8, 8), pixels).save(buffer, "PNG", compress_level=0)
    return buffer.getvalue()


def make_folder(folder: Path, count: int) -> None:
    one = tiny(0)
    for kind in range(CLASSES):
        (folder / f"class{kind:02d}").mkdir(parents=True)
    for number in range(count):
        (folder / f"class{number % CLASSES:02d}" / f"{number:07d}.png").write_bytes(one)


def make_zip(file: Path, count: int) -> None:
    one = tiny(0)
    with zipfile.ZipFile(file, "w") as archive:
        for number in range(count):
            archive.writestr(f"class{number % CLASSES:02d}/{number:07d}.png", one)


def make_shards(folder: Path, count: int, in_one: int = 10_000) -> None:
    folder.mkdir()
    for first in range(0, count, in_one):
        with tarfile.open(folder / f"train-{first // in_one:05d}.tar", "w") as tar:
            for number in range(first, min(first + in_one, count)):
                for ending, content in (("png", tiny(number)), ("cls", b"%d" % (number % CLASSES))):
                    info = tarfile.TarInfo(f"{number:07d}.{ending}")
                    info.size = len(content)
                    tar.addfile(info, io.BytesIO(content))


def start(source: Path) -> dict[str, Any]:
    """Seconds until a folder or zip is known, and what is known of it."""
    began, cpu = time.perf_counter(), time.process_time()
    with (found := take_inventory(source)).source as opened:
        listed = time.perf_counter() - began
        mark = fingerprint(opened, found.table.files, ())
    return {
        "files": len(found.table.files), "mark": mark, "listed_s": listed,
        "known_s": time.perf_counter() - began, "cpu_s": time.process_time() - cpu,
    }  # fmt: skip


def start_shards(source: Path) -> dict[str, Any]:
    """Seconds until training on shards could begin: the first time every picture is decoded."""
    began, cpu = time.perf_counter(), time.process_time()
    pictures = read_pictures(source, 8)
    total = int(pictures.images[:: max(1, len(pictures) // 64)].sum())
    return {
        "files": len(pictures), "mark": str(total),
        "known_s": time.perf_counter() - began, "cpu_s": time.process_time() - cpu,
    }  # fmt: skip


def in_a_process_of_its_own(source: Path, cache: Path) -> dict[str, Any]:
    said = subprocess.run(
        [sys.executable, __file__, "--start", str(source)],
        capture_output=True, text=True, check=True, env={**os.environ, "DERENDER_CACHE": str(cache)},
    )  # fmt: skip
    return json.loads(said.stdout)


def changes_are_seen(folder: Path, cache: Path) -> None:
    """A file added, removed or written over alters what is known; the end undoes it all."""
    before = in_a_process_of_its_own(folder, cache)
    file, other = folder / "class00" / "0000000.png", folder / "class01" / "new.png"
    content = file.read_bytes()
    steps = (
        ("added", lambda: other.write_bytes(content), 1),
        ("removed", other.unlink, 0),
        ("written over", lambda: file.write_bytes(content + b"\0"), 0),
    )
    for what, change, more in steps:
        change()
        time.sleep(SETTLED_SECONDS)  # so that the index of the next step is one that would be trusted
        after = in_a_process_of_its_own(folder, cache)
        if after["files"] != before["files"] + more or (
            what != "removed" and after["mark"] == before["mark"]
        ):
            raise SystemExit(f"a file that was {what} went unnoticed: nothing was measured")
    file.write_bytes(content)


def starts(source: Path, cache: Path) -> dict[str, Any]:
    """The first start, and two later ones, which must know the same."""
    first = in_a_process_of_its_own(source, cache)
    later = [in_a_process_of_its_own(source, cache) for _ in range(2)]
    if any(one["mark"] != first["mark"] or one["files"] != first["files"] for one in later):
        raise SystemExit(f"{source}: a later start knows something else than the first: nothing was measured")
    return {"files": first["files"], "first": first, "later": later}


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--files", type=int, default=200_000, help="files in the folder")
    parser.add_argument("--zip", type=int, default=1_000_000, help="members of the zip")
    parser.add_argument("--shards", type=int, default=200_000, help="samples in the shards")
    parser.add_argument("--start", type=Path, help=argparse.SUPPRESS)
    parser.add_argument("--json", type=Path, help="also write the numbers, machine and versions here")
    options = parser.parse_args()
    if options.start is not None:
        known = start_shards if options.start.name == "shards" else start
        print(json.dumps(known(options.start)))
        return
    results: dict[str, Any] = {}
    with tempfile.TemporaryDirectory() as name:
        root, cache = Path(name), Path(name) / "cache"
        if options.files:
            make_folder(root / "folder", options.files)
            time.sleep(SETTLED_SECONDS)
            changes_are_seen(root / "folder", cache)
            for kept in cache.glob("*.listing"):
                kept.unlink()
            time.sleep(SETTLED_SECONDS)
            results["folder"] = starts(root / "folder", cache)
        if options.zip:
            make_zip(root / "many.zip", options.zip)
            results["zip"] = starts(root / "many.zip", cache)
        if options.shards:
            make_shards(root / "shards", options.shards)
            results["shards"] = starts(root / "shards", cache)
    for kind, row in results.items():
        later = " and ".join(f"{one['known_s']:.2f}" for one in row["later"])
        print(f"{kind} of {row['files']:,}: first start {row['first']['known_s']:.2f} s, later {later} s")
    if options.json is not None:
        options.json.parent.mkdir(parents=True, exist_ok=True)
        result = {"benchmark": "reading", "starts": results, "machine": describe_machine()}
        options.json.write_text(json.dumps(result, indent=1) + "\n")


if __name__ == "__main__":
    main()
