"""Whether something is there: models, files and known words. Answers before anything heavy is imported.

A model is looked for in a folder, among the bundled models, then on the Hugging Face Hub.
"""

import importlib
import json
import re
from collections.abc import Iterable, Sequence
from difflib import get_close_matches
from pathlib import Path
from typing import Any

WEIGHTS_FILE, CONFIG_FILE = "model.safetensors", "config.json"
# A model may lack any of these; training/held_out_errors.py writes and reads the third.
WHITENING_FILE, FITTING_FILE = "whitening.safetensors", "fitting.safetensors"
ERRORS_FILE, SPLIT_FILE, CARD_FILE = "held_out_errors.json", "split.json", "README.md"
TENSOR_FILES = (WEIGHTS_FILE, WHITENING_FILE, FITTING_FILE)
TEXT_FILES = (CARD_FILE, ERRORS_FILE, SPLIT_FILE)
DEVICES = ("auto", "cpu", "cuda")
PRETRAINED = Path(__file__).parents[1] / "pretrained"
SUFFIXES = (  # file names that end in one of these are taken for images
    *(".jpg", ".jpeg", ".jpe", ".jfif", ".png", ".webp", ".avif", ".bmp", ".gif"),
    *(".tif", ".tiff", ".ppm", ".pgm", ".pnm", ".heic", ".heif"),
)


def optional(package: str, needed_for: str, extra: str = "baselines") -> Any:
    """A package that only a few calls need; ValueError with the extra to install where it is missing."""
    try:
        return importlib.import_module(package)
    except ImportError as error:
        what = f"{needed_for} needs the package {package.split('.')[0]}, which is not here ({error})"
        raise ValueError(f"{what}: pip install 'derender[{extra}]'") from error


def bundled_models() -> tuple[str, ...]:
    """Names of the trained models that come with derender; each has a card, ``pretrained/NAME/README.md``."""
    return tuple(sorted(folder.parent.name for folder in PRETRAINED.glob(f"*/{CONFIG_FILE}")))


def bundled_renderers() -> dict[str, str]:
    """The modules of `derender.renderers` that hold a function of their own name, by the renderer's name."""
    files = sorted((Path(__file__).parents[1] / "renderers").glob("*.py"))
    own = (file.stem for file in files if f"\ndef {file.stem}(" in file.read_text(encoding="utf-8"))
    return {name.replace("_", "-"): name for name in own}


def bundled(name: str) -> dict[str, Any]:
    """A bundled model's name, image size in pixels, size in megabytes, and what it was trained on."""
    folder = PRETRAINED / name
    network = json.loads((folder / CONFIG_FILE).read_text(encoding="utf-8"))["settings"]["network"]
    card = (folder / CARD_FILE).read_text(encoding="utf-8")
    about = re.split(r" ?[(:.\n]", card[card.index("**Trained on**") :].replace("**", ""))[0]
    size = round(sum(file.stat().st_size for file in folder.iterdir()) / 1e6)
    return {"name": name, "image_size": network["image_size"], "megabytes": size, "about": about}


def model_folder(source: str | Path) -> Path:
    """The folder that ``load`` reads for this source; a FileNotFoundError where nothing is there."""
    if not isinstance(source, (str, Path)):
        raise TypeError(f"a model is given by its name or folder, got {source!r}")
    folder = Path(source)
    for candidate in (folder, folder / "model"):
        if (candidate / CONFIG_FILE).is_file() and (candidate / WEIGHTS_FILE).is_file():
            return candidate
    if folder.exists():
        missing = f"expected {CONFIG_FILE} and {WEIGHTS_FILE} here or in 'model'"
        fix = "give a run folder made by 'derender train' or a folder made by model.save"
        raise FileNotFoundError(f"{folder} holds no model ({missing}): {fix}")
    if source in bundled_models():
        return PRETRAINED / source
    if hub_id(str(source)):
        return downloaded(str(source), (CONFIG_FILE, *TENSOR_FILES, *TEXT_FILES))
    own = f"one of those that come with derender ({', '.join(bundled_models())})"
    fix = f"give a run folder, a saved folder, a Hub id 'owner/name', or {own}"
    raise FileNotFoundError(f"no model at {source}: {fix}")


def downloaded(repository: str, names: Sequence[str]) -> Path:
    """Those of the named files that a repository has, downloaded and cached; gives their folder.

    A FileNotFoundError: the Hub gave nothing under that id, or cannot be reached and nothing is cached.
    """
    from huggingface_hub import snapshot_download
    from huggingface_hub.errors import HfHubHTTPError, HFValidationError

    try:
        return Path(snapshot_download(repository, allow_patterns=list(names)))
    except (HfHubHTTPError, HFValidationError, OSError) as error:
        why = f"the Hub gave nothing under that id ({type(error).__name__})"
        fix = "check the path or the id, and the network"
        raise FileNotFoundError(f"no folder {repository} here, and {why}: {fix}") from error


def hub_id(name: str) -> bool:
    """Whether a name reads OWNER/NAME."""
    return bool(re.fullmatch(r"[\w-][\w.-]*/[\w-][\w.-]*", name))


def suggestion(name: str, known: Iterable[str]) -> str:
    """``"; did you mean 'x'?"`` for the closest known name, or an empty string when nothing is close."""
    by_lower = {candidate.lower(): candidate for candidate in known}
    close = get_close_matches(name.lower(), by_lower, n=1, cutoff=0.5)
    return f"; did you mean {by_lower[close[0]]!r}?" if close else ""


def nearest_sibling(path: Path) -> str:
    """For "does not exist": a suggestion among the folders, archives and images beside it."""
    parent = path.absolute().parent
    if not parent.is_dir():
        return f"; nor does its folder {parent}"
    try:
        entries = sorted(parent.iterdir())
    except OSError:
        return ""
    known = (*SUFFIXES, ".zip", ".tar")
    return suggestion(path.name, [one.name for one in entries if one.is_dir() or one.name.endswith(known)])


def counted(number: int, nouns: str) -> str:
    """A number with its nouns, which end in s: "1 image", "1,200 images"."""
    noun = nouns[:-3] + "y" if nouns.endswith("ies") else nouns.removesuffix("s")
    return f"{number:,} {noun if number == 1 else nouns}"


def require_known(what: str, word: str, known: Sequence[str]) -> None:
    """Raise ValueError where a word is not known, with the nearest that is."""
    if word not in known:
        choices = f"{', '.join(known[:-1])} or {known[-1]}"
        raise ValueError(f"unknown {what} {word!r}{suggestion(word, known)}: choose {choices}")


def require_image(paths: Sequence[Path]) -> None:
    """Raise FileNotFoundError where none of the files is there."""
    if paths and not any(path.exists() for path in paths):
        raise FileNotFoundError(f"{paths[0]} does not exist{nearest_sibling(paths[0])}")


def require_images(address: str) -> None:
    """Raise ValueError where an address can only be a folder or a file, and none is there."""
    place = Path(re.sub(r"(::|\?).*", "", address)).expanduser()
    if not (Path(address).expanduser().exists() or place.exists() or hub_id(str(place)) or "{" in address):
        raise ValueError(f"{place} does not exist{nearest_sibling(place)}")
