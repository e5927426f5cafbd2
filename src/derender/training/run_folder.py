"""The files of a run, and the rules under which its folder may be written."""

import json
import platform
import subprocess
from contextlib import suppress
from hashlib import sha256
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from reprlib import Repr
from typing import Annotated, Any, NotRequired

import numpy as np
import torch
from pydantic import ConfigDict, Field, FiniteFloat
from typing_extensions import TypedDict

from derender.data import ImageSet, Split
from derender.overrides import checked, settings_by_name
from derender.settings import Settings
from derender.storage import bounded
from derender.storage.atomic import remove_abandoned, write_whole
from derender.training.checkpoint import read_state
from derender.training.config import TrainConfig, to_yaml, without_removed
from derender.training.process import LOCK_FILE

FORMAT = 1  # of config.yaml, which says so in its first line; one that does not is of this format, too

_MAY_CHANGE_ON_RESUME = (
    *("images", "minutes", "validate_every", "sample_every", "checkpoint_every", "patience", "watch", "keep"),
    *("accumulate", "cuda_graph", "compile"),
    "optimiser",  # a run that the watcher stopped goes on with a smaller rate
)
_BEGUN = (LOCK_FILE, "environment.json", ".environment.json-", ".config.yaml-")  # there before config.yaml
_REPORTED_PACKAGES = ("derender", "torch", "numpy", "numba", "lightning-fabric", "safetensors", "pillow")


class RunFolder:
    """Paths inside one run; ``previous`` is the checkpoint before the last."""

    def __init__(self, path: Path):
        self.path = path
        self.config, self.metrics = path / "config.yaml", path / "metrics.jsonl"
        checkpoints = path / "checkpoints"
        self.last, self.previous, self.best = (checkpoints / name for name in ("last", "previous", "best"))
        self.samples, self.model = path / "samples", path / "model"
        self.perceptual = path / "perceptual.safetensors"

    @property
    def resumable(self) -> bool:
        """Whether there is a checkpoint to go on from."""
        return self.last.exists() or self.previous.exists()


def start_run(path: Path, config: Settings, data: dict[str, Any], device: str) -> RunFolder:
    """Make a new run folder; one that holds anything already is never touched: a FileExistsError."""
    refuse_taken(path)
    run = RunFolder(path)
    run.samples.mkdir(parents=True, exist_ok=True)
    write_whole(path / "environment.json", json.dumps({**environment(device), "data": data}, indent=1))
    write_whole(run.config, f"format: {FORMAT}\n{to_yaml(config)}")
    return run


def refuse_taken(path: Path) -> None:
    """FileExistsError where a folder holds anything but the traces of a run that hardly began."""
    if not path.exists():
        return
    for entry in path.iterdir() if path.is_dir() else [path]:
        empty = entry.name == "samples" and entry.is_dir() and not any(entry.iterdir())
        if not empty and not entry.name.startswith(_BEGUN):
            fix = "add --resume to continue that run, or choose another --out"
            raise FileExistsError(f"{path} exists and is not empty: {fix}")


def reopen_run(path: Path, config: Settings, data: dict[str, Any]) -> RunFolder:
    """The folder of a run to resume; no run is a FileNotFoundError, other settings or data a ValueError."""
    run = RunFolder(path)
    if not run.config.is_file():
        raise FileNotFoundError(f"no run to resume in {path} (no config.yaml): train without --resume first")
    both = (one.model_dump(mode="json") for one in (read_config(path, type(config)), config))
    stored, asked = map(settings_by_name, both)
    for key in {**stored, **asked}:
        if key.partition(".")[0] not in _MAY_CHANGE_ON_RESUME and asked.get(key) != stored.get(key):
            other = f"{path} was trained with another {key} ({stored.get(key)}, now {asked.get(key)})"
            raise ValueError(f"{other}: resume with the same settings, or start a new run in another folder")
    changed = [key for key in asked if key != "keep" and asked[key] != stored.get(key)]
    if changed and (end := (state := read_state(run.last)).ended_by(config)):
        what = f"{path} has seen {state.images:,} images and would train no further ({end}={asked[end]})"
        fix = f"raise {end}, or resume with the run's own settings"
        raise ValueError(f"{what}, so another {changed[0]} has no effect: {fix}")
    _require_same(path, data)
    for written in (run.last, run.best, run.model, run.config, run.metrics, run.perceptual):
        remove_abandoned(written)
    write_whole(run.config, f"format: {FORMAT}\n{to_yaml(config)}")
    return run


def read_config(path: Path, kind: type[Any] = TrainConfig) -> Any:
    """The configuration of a run; one that is damaged or not of this kind is a ValueError."""
    tree = read_config_tree(path)
    expected = kind.model_fields.get("baseline")
    trained, name = tree.get("baseline"), None if expected is None else expected.default
    if trained != name:
        names = [f"the baseline {one}" if one else "a derender model" for one in (trained, name)]
        raise ValueError(f"{path} is a run of {names[0]}, not of {names[1]}: give another run folder")
    return checked(tree, kind)


def read_config_tree(path: Path) -> dict[str, Any]:
    """The configuration of a run as plain values, whatever it trained; errors as of `read_settings`."""
    advice = "is damaged: restore it, or start a new run in another folder"
    return read_settings(path / "config.yaml", advice)


def read_settings(
    file: Path, otherwise: str = "holds no settings: write YAML, one key: value a line"
) -> dict[str, Any]:
    """The settings in a YAML file or a run folder, as plain values.

    A FileNotFoundError: there is none; a ValueError: it holds no settings (``otherwise``), or is of a newer
    version.
    """
    file = file / "config.yaml" if file.is_dir() else file
    if not file.is_file():
        raise FileNotFoundError(f"no settings in {file}: give a YAML file, such as a run's config.yaml")
    try:
        tree = bounded.parse_yaml(bounded.read_text(file))
        if not isinstance(tree, dict):
            raise ValueError("no settings by name")
    except ValueError as error:
        raise ValueError(f"{file} {otherwise} ({error})") from error
    result = tree.pop("format", FORMAT)
    if not isinstance(result, int) or result > FORMAT:
        newer = f"was written in format {Repr().repr(result)}, this version reads up to {FORMAT}"
        raise ValueError(f"{file} {newer}: update derender")
    return without_removed(tree)


class MetricsRow(TypedDict):
    """A line of metrics.jsonl; numbers, which may be NaN, and words by further names."""

    __pydantic_config__ = ConfigDict(extra="allow")  # pyrefly: ignore[bad-class-definition]
    kind: NotRequired[str]
    images: Annotated[int, Field(ge=0)]
    seconds: NotRequired[FiniteFloat]


def append_metrics(run: RunFolder, row: dict[str, Any]) -> None:
    """Add one line to metrics.jsonl."""
    with run.metrics.open("a") as file:
        file.write(json.dumps(row) + "\n")


def read_metrics(path: Path) -> list[dict[str, Any]]:
    """Every complete line of a run's metrics.jsonl; a ValueError names one that is none."""
    file = RunFolder(path).metrics
    if not file.exists():
        return []
    rows = []
    try:
        lines = bounded.read_bounded(file, bounded.LINES_LIMIT_BYTES).splitlines(keepends=True)
    except ValueError as error:
        raise ValueError(f"{file} is damaged ({error}): move it away") from error
    for number, line in enumerate(lines, 1):
        try:
            rows.append(dict(bounded.parse_json(line, MetricsRow)))
        except ValueError as error:
            if number == len(lines) and line[:1] == b"{" and line[-1:] != b"\n":  # cut off by a kill
                break
            where = f"line {number}: {bounded.first_line(error)}"
            raise ValueError(f"{file} is damaged ({where}): delete that line") from error
    return rows


def drop_metrics_after(run: RunFolder, images: int) -> None:
    """Drop rows written after a checkpoint, so that a resumed run writes them once."""
    kept = [row for row in read_metrics(run.path) if row.get("images", 0) <= images]
    write_whole(run.metrics, "".join(json.dumps(row) + "\n" for row in kept))


def environment(device: str) -> dict[str, Any]:
    """Versions, machine and commit, to repeat the run."""
    command = ["git", "-C", str(Path(__file__).parent), "rev-parse", "HEAD"]
    packages: dict[str, str | None] = dict.fromkeys(_REPORTED_PACKAGES)
    for package in packages:
        with suppress(PackageNotFoundError):
            packages[package] = version(package)
    commit = ""
    with suppress(OSError, subprocess.TimeoutExpired):
        done = subprocess.run(command, capture_output=True, text=True, timeout=5, check=False)
        commit = done.stdout.strip()
    return {
        "python": platform.python_version(),
        "platform": platform.platform(terse=True),
        "processor_threads": torch.get_num_threads(),
        "device": device,
        "packages": packages,
        "commit": commit or None,
    }


def describe_data(images: ImageSet, split: Split) -> dict[str, Any]:
    """The data of a run, for its environment.json: counts, and by what it is known again."""
    parts = {"pictures": images, **vars(split), "skipped": images.skipped, "duplicates": images.duplicates}
    names = sha256("\0".join(images.files).encode("utf-8", "backslashreplace")).hexdigest()
    some = images.images[:: max(1, len(images) // 16)].mean(axis=(1, 2, 3)).round(2)
    counts = {name: len(values) for name, values in parts.items()}
    return {"layout": images.layout, **counts, "names": names, "levels": some.tolist()}


def _require_same(path: Path, data: dict[str, Any]) -> None:
    """A ValueError where a run recorded other images than ``data`` describe; old runs recorded less."""
    file = path / "environment.json"
    stored = bounded.parse_json(bounded.read_text(file), dict[str, Any]) if file.is_file() else {}
    began = data | stored.get("data", {})
    same = all(began[key] == data[key] for key in ("layout", "pictures", "names"))
    if same and np.allclose(began["levels"], data["levels"], rtol=0, atol=1):  # decoders differ by less
        return
    one, other = (f"{each.get('pictures')} images ({each.get('layout')})" for each in (began, data))
    fix = "resume with those or set start_from"
    raise ValueError(f"{path} was trained on {one}, not on these {other}: {fix}")
