"""Saving, packing and sharing a model: beside its weights a card, held-out errors and its split; to the Hub.

The card is the README.md that states what a model is, what made it and what it may be used for. A packed
model takes fewer bytes: weights in half precision, large maps in bytes with a unit for each slice.
"""

import json
import re
from abc import abstractmethod
from collections.abc import Mapping
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from torch import Tensor

from derender.storage import folder as files
from derender.storage.atomic import new_folder
from derender.storage.bounded import parse_json, read_bounded
from derender.storage.folder import HeldOutErrors, texts_beside
from derender.storage.places import CARD_FILE, ERRORS_FILE, SPLIT_FILE, model_folder, require_known
from derender.storage.tensors import UNIT, packed, read_described, write_tensors


class Shareable:
    """Saving, for a model that can write its own files; ``source`` is the folder its weights come from."""

    settings: Any
    factors: Any
    source: Path | None = None

    @abstractmethod
    def write(self, folder: Path) -> None:
        """Write the model's own files into an existing folder."""

    @abstractmethod
    def tensors(self) -> dict[str, Tensor]:
        """All tensors that ``write`` writes, by name."""

    def save(self, folder: str | Path, *, overwrite: bool = False) -> Path:
        """Write settings and weights to ``folder``; complete or not at all."""
        with new_folder(folder, overwrite=overwrite) as temporary:
            self.write(temporary)
        return Path(folder)

    def save_pretrained(
        self, folder: str | Path, *, card: str | None = None, data: str | None = None,
        licence: str | None = None, scores: str | None = None, overwrite: bool = False,
    ) -> Path:  # fmt: skip
        """As ``save``, with what a shared model needs: a card (README.md), held-out errors and its split.

        They are those of the folder it was loaded from, as long as its weights are. Otherwise the card is
        ``card``, or is made of ``data`` (what it was trained on), ``licence`` and ``scores``.
        """
        beside = texts_beside(self.source, self.tensors())
        card = card or self._card(beside, Path(folder).name, data, licence, scores)
        with new_folder(folder, overwrite=overwrite) as temporary:
            self.write(temporary)
            (temporary / CARD_FILE).write_text(with_metadata(card, licence), encoding="utf-8")
            for name in {ERRORS_FILE, SPLIT_FILE} & beside.keys():
                (temporary / name).write_text(beside[name], encoding="utf-8")
        return Path(folder)

    def push_to_hub(
        self, repository: str, *, card: str | None = None, data: str | None = None,
        licence: str | None = None, scores: str | None = None, private: bool = False,
        token: str | None = None,
    ) -> str:  # fmt: skip
        """Upload the model to the Hugging Face Hub as ``save_pretrained`` writes it; returns its address.

        ValueError: no card, data and licence; PermissionError: the Hub refuses; ConnectionError: no Hub.
        """
        from huggingface_hub import HfApi
        from huggingface_hub.errors import HfHubHTTPError, HFValidationError, LocalTokenNotFoundError

        beside = texts_beside(self.source, self.tensors())
        own = CARD_FILE in beside and not (data or licence or scores)  # part of one would drop the licence
        if not (card or (data and licence) or own):
            how = "push_to_hub(..., data=..., licence=...), or pass card="
            what = "state what it was trained on and what it may be used for"
            raise ValueError(f"a card needs both: {what}, {how}")
        card = card or self._card(beside, repository, data, licence, scores)
        with TemporaryDirectory() as place:
            folder = self.save_pretrained(Path(place) / "model", card=card, licence=licence)
            hub = HfApi(token=token)
            try:
                made = hub.create_repo(repository, private=private, exist_ok=True)
                hub.upload_folder(repo_id=made.repo_id, folder_path=folder, commit_message="A derender model")
            except HFValidationError as error:
                raise ValueError(f"{repository!r} is no name on the Hub: give OWNER/NAME") from error
            except (HfHubHTTPError, LocalTokenNotFoundError) as error:
                why = " ".join(str(error).split())
                fix = "log in with 'hf auth login' or pass token=, with the right to write there"
                raise PermissionError(f"the Hub refuses {repository} ({why}): {fix}") from error
            except Exception as error:  # the client's HTTP library decides what a broken connection raises
                what = f"the Hub cannot be reached ({type(error).__name__}: {error})"
                fix = "nothing is lost: model.save_pretrained writes the same files to a folder"
                raise ConnectionError(f"{what}; {fix}") from error
        return str(made)

    def _card(self, beside: Mapping[str, str], title: str, *stated: str | None) -> str:
        """The card that lies beside the weights, unless data, licence or scores are stated."""
        if CARD_FILE in beside and not any(stated):
            return beside[CARD_FILE]
        data, licence, scores = stated
        renderer = self.settings.renderer
        own = f', renderer="{renderer}"' if ":" in renderer else ""  # a user's module: where it is named only
        measured = " ".join(filter(None, [scores, _errors_in_words(beside.get(ERRORS_FILE, ""))]))
        parts = {"Trained on": data, "Scores": measured, "Licence": licence}
        does = self.settings.description([row.name for row in self.factors])
        code = f'```python\nimport derender\n\nmodel = derender.load("{title}"{own})\n```'
        lines = (f"**{name}**: {text or 'not stated'}" for name, text in parts.items())
        return "\n\n".join([f"# {title}", does, code, *lines]) + "\n"


def with_metadata(card: str, licence: str | None = None) -> str:
    """The card headed by what the Hub files it under, unless it has a head of its own."""
    if card.startswith("---"):
        return card
    tags = "library_name: derender\ntags: [inverse-rendering, disentanglement]\n"
    if licence and len(licence) <= 32 and " " not in licence:  # a short name, such as MIT, and no sentence
        tags += f"license: {json.dumps(licence.lower())}\n"
    return f"---\n{tags}---\n\n{card}"


def _errors_in_words(errors: str) -> str:
    """Median and 99th percentile of held-out errors (JSON); empty where there are none."""
    try:
        stored = parse_json(errors, HeldOutErrors)
    except ValueError:
        return ""
    median, high = stored.quantiles[50], stored.quantiles[99]
    values = f"median {median:.4f}, 99th percentile {high:.4f} (0..1, best 0)"
    return f"Masked L1 of reconstructions of {stored.pictures:,} held-out images: {values}."


KINDS = ("bytes", "float16")  # of the large maps of whitening and fitting; weights are float16 in both
_LARGE = re.compile(r"\w+_map|maps\.\w+_axes|framing\.weight\d")


def pack_model(
    source: str | Path, folder: str | Path, *, maps: str = "bytes", overwrite: bool = False
) -> dict[str, int]:
    """Write a model in fewer bytes, with what lies beside its weights; complete or not at all.

    Gives the bytes of the tensors' files "before" and "after". ``maps`` are kept as "bytes", a 127th of the
    largest number of each slice apart, or "float16". A FileExistsError: ``folder`` exists, without
    ``overwrite``; a FileNotFoundError: no model is at ``source``; a ValueError: it is damaged, or a weight is
    no number of half precision.
    """
    require_known("kind of maps", maps, KINDS)
    own, sizes = model_folder(source), {"before": 0, "after": 0}
    files.read_config(own)
    with new_folder(folder, overwrite=overwrite) as temporary:
        for file in files.TENSOR_FILES:
            if not (own / file).is_file():
                continue
            tensors, metadata = read_described(own / file)
            small = dict(tensors)
            for name, value in tensors.items():
                weight = file == files.WEIGHTS_FILE and value.is_floating_point()
                if maps == "bytes" and _LARGE.fullmatch(name):
                    small[name], small[name + UNIT] = packed(value.float(), along=0)
                elif weight or _LARGE.fullmatch(name):
                    small[name] = value.half()
                    if not bool(small[name].isfinite().all()):
                        what = f"{name} has numbers that half precision cannot hold (beyond 65,504, or NaN)"
                        fix = "its training went wrong, train it again"
                        raise ValueError(f"{what}, so this model cannot be packed: {fix}")
            write_tensors(small, temporary / file, metadata)
            sizes["before"] += (own / file).stat().st_size
            sizes["after"] += (temporary / file).stat().st_size
        for file in (files.CONFIG_FILE, *files.TEXT_FILES):
            if (own / file).is_file():
                (temporary / file).write_bytes(read_bounded(own / file))
    return sizes
