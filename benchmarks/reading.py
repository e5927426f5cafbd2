"""How long it takes until a very large folder, zip or set of shards is known, at first and later.

Made-up sets of tiny files lie in a temporary folder: a folder of class folders, a zip, tars. A start is what
a command does before the first image is decoded: list, recognise the layout, read labels, ask every file's
size and time of change (``identity``). Of shards the first start decodes, later ones find the decoded images
in the cache. Every start runs in a process of its own; imports are not counted. Files stay in the system's
cache. A million small files take 4 GB; ``--place`` keeps the sets for another run.

    python benchmarks/reading.py --files 1000000 --zip 1000000 --shards 100000
"""

import argparse
import io
import json
import os
import resource
import subprocess
import sys
import tarfile
import tempfile
import time
import zipfile
from contextlib import nullcontext
from pathlib import Path
from typing import Any

from machine import parser, publish
from PIL import Image

from derender.data import list_images, read_images

CLASSES = 20


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


def most_memory_mb() -> float:
    """The highest resident memory of this process so far, imports included."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def start(source: Path) -> dict[str, Any]:
    """Seconds until a folder or zip is known, and what is known of it."""
    began, cpu = time.perf_counter(), time.process_time()
    with list_images(source) as result:
        listed = time.perf_counter() - began
        mark = result.identity()
    return {
        "files": len(result.table.files), "mark": mark, "listed_s": listed,
        "known_s": time.perf_counter() - began, "cpu_s": time.process_time() - cpu,
        "memory_mb": most_memory_mb(),
    }  # fmt: skip


def start_shards(source: Path) -> dict[str, Any]:
    """Seconds until training on shards could begin: the first time every image is decoded."""
    began, cpu = time.perf_counter(), time.process_time()
    pictures = read_images(source, 8)
    total = int(pictures.images[:: max(1, len(pictures) // 64)].sum())
    return {
        "files": len(pictures), "mark": str(total),
        "known_s": time.perf_counter() - began, "cpu_s": time.process_time() - cpu,
        "memory_mb": most_memory_mb(),
    }  # fmt: skip


def in_a_process_of_its_own(source: Path, cache: Path) -> dict[str, Any]:
    said = subprocess.run(
        [sys.executable, __file__, "--start", str(source)],
        capture_output=True, text=True, check=True, env={**os.environ, "DERENDER_CACHE": str(cache)},
    )  # fmt: skip
    return json.loads(said.stdout)


def starts(source: Path, cache: Path) -> dict[str, Any]:
    """The first start, and two later ones, which must know the same."""
    first = in_a_process_of_its_own(source, cache)
    later = [in_a_process_of_its_own(source, cache) for _ in range(2)]
    if any(one["mark"] != first["mark"] or one["files"] != first["files"] for one in later):
        raise SystemExit(f"{source}: a later start knows something else than the first: nothing was measured")
    return {"files": first["files"], "first": first, "later": later}


def main() -> None:
    asks = parser(__doc__)
    asks.add_argument("--files", type=int, default=200_000, help="files in the folder")
    asks.add_argument("--zip", type=int, default=1_000_000, help="members of the zip")
    asks.add_argument("--shards", type=int, default=200_000, help="samples in the shards")
    asks.add_argument("--place", type=Path, help="make the sets here and leave them; those there are used")
    asks.add_argument("--start", type=Path, help=argparse.SUPPRESS)
    options = asks.parse_args()
    if options.start is not None:
        known = start_shards if options.start.name == "shards" else start
        print(json.dumps(known(options.start)))
        return
    results: dict[str, Any] = {}
    with (
        nullcontext(options.place) if options.place else tempfile.TemporaryDirectory() as name,
        tempfile.TemporaryDirectory() as kept,
    ):
        root, cache = Path(name), Path(kept)
        for kind, count, file, make in (
            ("folder", options.files, root / "folder", make_folder),
            ("zip", options.zip, root / "many.zip", make_zip),
            ("shards", options.shards, root / "shards", make_shards),
        ):
            if not count:
                continue
            if not file.exists():
                make(file, count)
            results[kind] = starts(file, cache)
    for kind, row in results.items():
        each = (row["first"], *row["later"])
        wall = ", ".join(f"{one['known_s']:.2f}" for one in each)
        cpu = ", ".join(f"{one['cpu_s']:.2f}" for one in each)
        print(f"{kind} of {row['files']:,}: first start and later ones {wall} s; processor {cpu} s")
        print(f"  at most {max(one['memory_mb'] for one in each):,.0f} MB in memory")
    publish({"benchmark": "reading", "starts": results}, options.json)


if __name__ == "__main__":
    main()
