"""Images a second of the generators of faces and cars, all ground truth included: in memory and on disk.

First it is shown that one thread and all threads make the same bytes. Wall time says what a user waits, and
is true on a quiet machine only; CPU time (of all threads together) moves less with other work. The load says
which it was: the mean number of busy processes over the last minute, before and after.

    .venv/bin/python benchmarks/synthesis.py --rounds 5 --json synthesis.json
"""

import hashlib
import json
import os
import statistics
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import torch
from machine import parser, publish

from derender.data.synthetic import SyntheticSet, cars, faces, write

GENERATORS = {"faces": faces.generate, "cars": cars.generate}
MAPS = ("images", "depth", "normal", "albedo", "mask", "parts", "light", "camera", "identity")


def digest(made: SyntheticSet) -> str:
    """One hash of every map."""
    return hashlib.sha256(b"".join(getattr(made, name).tobytes() for name in MAPS)).hexdigest()


def check_threads(generate: Callable[..., SyntheticSet], threads: int) -> None:
    """Stop unless one thread makes the same bytes as all of them; the kernels are compiled on the way."""
    result = set()
    for number in (1, threads):
        torch.set_num_threads(number)
        result.add(digest(generate(64, seed=3)))
    assert len(result) == 1, "the bytes depend on the number of threads"


def rounds_of(work: Callable[[int], object], count: int, rounds: int) -> dict[str, float | list[float]]:
    """Wall rate and CPU time of each round, its number given to ``work``; the middle and the best of them."""
    rates, cpu_ms = [], []
    for number in range(rounds):
        wall, cpu = time.perf_counter(), time.process_time()
        work(number)
        rates.append(count / (time.perf_counter() - wall))
        cpu_ms.append(1e3 * (time.process_time() - cpu) / count)
    return {
        "pictures_per_s": statistics.median(rates),
        "pictures_per_s_rounds": rates,
        "cpu_ms_per_picture": statistics.median(cpu_ms),
        "cpu_ms_per_picture_best": min(cpu_ms),
    }


def measure(name: str, count: int, rounds: int, size: int, threads: int) -> dict[str, object]:
    """One generator: on one thread, on all threads, and with all files written as the command does."""
    generate = GENERATORS[name]

    def in_memory(number: int) -> None:
        generate(count, size, seed=number)

    def to_disk(number: int) -> None:
        with tempfile.TemporaryDirectory() as folder:
            write(generate(count, size, seed=number), Path(folder) / "set")

    check_threads(generate, threads)
    torch.set_num_threads(1)
    one = rounds_of(in_memory, count, rounds)
    torch.set_num_threads(threads)
    every = rounds_of(in_memory, count, rounds)
    return {"one_thread": one, "all_threads": every, "all_threads_written": rounds_of(to_disk, count, rounds)}


def main() -> None:
    asks = parser(__doc__)
    asks.add_argument("--count", type=int, default=1024, help="images in a round")
    asks.add_argument("--rounds", type=int, default=5)
    asks.add_argument("--image-size", type=int, default=64)
    asks.add_argument("--threads", type=int, default=os.cpu_count() or 1)
    asks.add_argument("--only", choices=list(GENERATORS))
    options = asks.parse_args()
    load = [os.getloadavg()[0]]
    results: dict[str, object] = {
        name: measure(name, options.count, options.rounds, options.image_size, options.threads)
        for name in GENERATORS
        if options.only in (None, name)
    }
    load.append(os.getloadavg()[0])
    results |= {"count": options.count, "image_size": options.image_size, "load": load}
    print(json.dumps(results, indent=1))
    publish(results, options.json)


if __name__ == "__main__":
    main()
