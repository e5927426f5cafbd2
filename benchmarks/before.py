"""A command of this tree and of an earlier commit in turns: seconds, processor seconds, and what both print.

The earlier commit is checked out for as long as it takes. Each run starts with an empty cache of scores.
`same` says whether what both printed last is equal, character by character.

    python benchmarks/before.py 4929e15 --rounds 3 --json disentangle.json \
        evaluate disentangle --data synface64.zip --model rendered-faces-64 --limit 400
"""

import os
import resource
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from machine import ROOT, parser, publish


def run(tree: Path, words: list[str]) -> tuple[float, float, str]:
    """Seconds, processor seconds and what was printed."""
    with tempfile.TemporaryDirectory() as cache:
        own = {"PYTHONPATH": str(tree / "src"), "DERENDER_CACHE": cache, "XDG_CACHE_HOME": cache}
        used, began = resource.getrusage(resource.RUSAGE_CHILDREN), time.monotonic()
        command = [sys.executable, "-m", "derender", *words]
        done = subprocess.run(command, env=os.environ | own, capture_output=True, text=True, check=True)
        took, now = time.monotonic() - began, resource.getrusage(resource.RUSAGE_CHILDREN)
    return took, now.ru_utime + now.ru_stime - used.ru_utime - used.ru_stime, done.stdout


def git(*words: str) -> None:
    """Keep worktrees of this repository."""
    subprocess.run(["git", "-C", str(ROOT), "worktree", *words], check=True, capture_output=True)


def main() -> None:
    asks = parser(__doc__)
    asks.add_argument("commit", help="the earlier commit")
    asks.add_argument("--rounds", type=int, default=3)
    asks.add_argument("words", nargs="+", help="a command of derender")
    options, rest = asks.parse_known_args()
    words, seconds, printed = [*options.words, *rest], {"before": [], "now": []}, {}
    with tempfile.TemporaryDirectory() as folder:
        earlier = Path(folder) / "earlier"
        git("add", "--detach", str(earlier), options.commit)
        try:
            for number in range(1, options.rounds + 1):
                for name, tree in (("before", earlier), ("now", ROOT)):
                    *taken, printed[name] = run(tree, words)
                    seconds[name].append(taken)
                    print(f"round {number}, {name}: {taken[0]:.1f} s", flush=True)
        finally:
            git("remove", "--force", str(earlier))
    rows = [
        {"name": name, "seconds": statistics.median(one for one, _ in taken),
         "processor_seconds": statistics.median(one for _, one in taken), "rounds": taken}
        for name, taken in seconds.items()
    ]  # fmt: skip
    result = {"command": " ".join(Path(word).name for word in words), "commit": options.commit, "rows": rows}
    result |= {"ratio": rows[0]["seconds"] / rows[1]["seconds"], "same": printed["before"] == printed["now"]}
    print(f"{result['ratio']:.2f} times as fast, " + ("the same" if result["same"] else "other numbers"))
    publish({"benchmark": "before", **result}, options.json)


if __name__ == "__main__":
    main()
