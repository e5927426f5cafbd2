"""Images that are broken, odd or meant to do harm, made on the spot, and every command that reads images.

    python tests/trust/hostile.py

writes them to a temporary folder, runs each command on all of them in a process of its own, and tells exit
code, time and peak memory. A traceback, another exit code than is due, unreadable files that are not counted
(where a folder is read) or not named (where files are), and more memory than ``MEMORY_LIMIT_MB`` are faults.
"""

import argparse
import os
import sys
import tempfile
from pathlib import Path

from hostility.commands import MODEL, Ended, commands, picture_commands, run_apart, uploads
from hostility.files import labelled, named_in, write_hostile, write_hostile_zip

MEMORY_LIMIT_MB = 3_000
"""Of a process, interpreter and network included; an image of 169 million pixels takes 676 MB by itself."""


def not_refused(ended: Ended) -> list[str]:
    return [] if ended.code == 2 else [f"exit code {ended.code}: {ended.said[-400:]}"]


def run_all() -> int:
    """The script."""
    faults: list[str] = []

    def tell(name: str, ended: Ended, wrong: list[str]) -> None:
        if "Traceback" in ended.said:
            wrong.append(f"a traceback: {ended.said[-1500:]}")
        if ended.megabytes > MEMORY_LIMIT_MB:
            wrong.append(f"{ended.megabytes:,.0f} MB")
        print(f"{name}: exit code {ended.code}, {ended.seconds:.0f} s, {ended.megabytes:,.0f} MB", flush=True)
        for one in wrong:
            print(f"  {one}", flush=True)
        faults.extend(wrong)

    with tempfile.TemporaryDirectory() as folder:
        place = Path(folder)
        os.environ["DERENDER_CACHE"] = str(place / "cache")
        hostile = write_hostile(place / "hostile")
        print(
            f"{len(hostile.readable)} odd images, {len(hostile.unreadable)} that cannot be read", flush=True
        )
        data, broken = labelled(place / "classes", hostile)
        for name, (arguments, due) in commands(place, data).items():
            ended = run_apart(arguments, place / "log")
            wrong = (
                [] if ended.code == due else [f"exit code {ended.code} and not {due}: {ended.said[-400:]}"]
            )
            if not due and "robustness" not in name and f"{broken} skipped" not in ended.said:
                wrong.append(f"does not count {broken} skipped files: {ended.said[:400]}")
            tell(name, ended, wrong)
        archive = write_hostile_zip(place / "hostile.zip")
        embed = ["embed", "--model", MODEL, "--device", "cpu", "--out", str(place / "Z.parquet")]
        ended = run_apart([*embed, "--data", str(archive)], place / "log")
        due = ended.code == 0 and "8 skipped" in ended.said
        tell("embed of a zip", ended, [] if due else [f"not 8 skipped: {ended.said}"])
        names = [name for name in (*hostile.readable, *hostile.unreadable) if "xff" not in name]
        files = [str(hostile.folder / name) for name in names]
        for name, arguments in picture_commands(place, files, files[0]).items():
            ended = run_apart(arguments, place / "log")
            unnamed = named_in(ended.said.replace("\\t", " "), hostile.unreadable)
            wrong = [f"does not name {unnamed}"] if unnamed else []
            tell(name, ended, wrong + not_refused(ended))
        for file in ("empty.png", "nan.tif", "bomb.png", "cut 08 of 16.jpg", "to itself.png", "pipe.png"):
            search = ["search", "--features", str(place / "F.parquet"), "--model", MODEL, "--device", "cpu"]
            ended = run_apart([*search, "--like", str(hostile.folder / file)], place / "log")
            tell(f"search --like {file}", ended, not_refused(ended))
        faults += (wrong := uploads(hostile))
        print(f"view, every file uploaded: {len(wrong)} answered otherwise than is due {wrong}")
    print(f"{len(faults)} faults")
    return 1 if faults else 0


if __name__ == "__main__":
    argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    ).parse_args()
    sys.exit(run_all())
