"""One command of derender whose numbers are kept, with the command, machine, versions, commit and day.

    python benchmarks/score.py benchmarks/results/generated/heads.json evaluate geometry made/ --model M

A file that is there is left as it is, so that a stopped `make results` goes on. Lists of single images are
left out: means and intervals stay.
"""

import json
import sys
import tempfile
from pathlib import Path
from typing import Any

from machine import publish

from derender.cli import main as derender

LONGEST_LIST = 16


def short(value: Any) -> Any:
    """A value without the lists that hold a number for each image."""
    if isinstance(value, dict):
        kept = {key: short(one) for key, one in value.items()}
        return {
            key: one for key, one in kept.items() if not isinstance(one, list) or len(one) <= LONGEST_LIST
        }
    return [short(one) for one in value] if isinstance(value, list) else value


def main() -> int:
    file, words = Path(sys.argv[1]), sys.argv[2:]
    if file.exists():
        return 0
    with tempfile.TemporaryDirectory() as folder:
        scores = Path(folder) / "scores.json"
        code = derender([*words, "--json", str(scores)])
        if code:
            return code
        result = short(json.loads(scores.read_text()))
    publish({"command": " ".join(["derender", *words]), **result}, file)
    return 0


if __name__ == "__main__":
    sys.exit(main())
