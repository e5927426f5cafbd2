"""Which pictures a saved model was not trained on: the split of its run, kept with the weights.

A run folder says it in its configuration; copies made of its model (whitened, refined, given away) in a small
JSON file. Parts are drawn from files' names (``data.splits``), so shares and a seed say all.
"""

import json
from dataclasses import asdict, dataclass
from pathlib import Path

from derender.storage.atomic import atomic_file
from derender.storage.folder import SPLIT_FILE

FORMAT = 1


@dataclass(frozen=True)
class SplitRecord:
    """The split of the run a model comes from.

    Attributes:
        shares: of training, validation and test, which sum to 1.
        seed: that they were drawn with.
    """

    shares: tuple[float, float, float]
    seed: int


def write_split(folder: Path, split: SplitRecord) -> None:
    """Write the file into a saved model's folder; whole or not at all."""
    with atomic_file(folder / SPLIT_FILE) as temporary:
        temporary.write_text(json.dumps({"format": FORMAT, **asdict(split)}) + "\n")


def read_split(folder: Path) -> SplitRecord | None:
    """What was kept with the model in ``folder``; None where nothing was.

    Raises:
        ValueError: the file is damaged or of a newer version.
    """
    file = folder / SPLIT_FILE
    if not file.is_file():
        return None
    try:
        values = json.loads(file.read_text())
        train, validation, test = (float(share) for share in values["shares"])
        sound = values["format"] == FORMAT and abs(train + validation + test - 1) < 1e-6
        found = SplitRecord((train, validation, test), int(values["seed"])) if sound else None
    except (UnicodeDecodeError, KeyError, TypeError, ValueError):
        found = None
    if found is None:
        raise ValueError(f"{file} is damaged or of a newer version: take the model again, or update derender")
    return found
