"""Saving and sharing a model: beside its weights a card, held-out errors and its split; the way to the Hub.

The card is the README.md that states what a model is, what made it and what it may be used for.
"""

import json
from abc import abstractmethod
from collections.abc import Mapping
from pathlib import Path
from tempfile import TemporaryDirectory

from torch import Tensor

from derender.storage import hub
from derender.storage.atomic import new_folder
from derender.storage.bounded import parse_json
from derender.storage.folder import ErrorsFile, texts_beside
from derender.storage.places import CARD_FILE, ERRORS_FILE, SPLIT_FILE


class Shareable:
    """Saving, for a model that can write its own files; ``source`` is the folder its weights come from."""

    source: Path | None = None

    @abstractmethod
    def write(self, folder: Path) -> None:
        """Write the model's own files into an existing folder."""

    @abstractmethod
    def tensors(self) -> dict[str, Tensor]:
        """All tensors that ``write`` writes, by name."""

    @abstractmethod
    def description(self) -> str:
        """One sentence for the card: what the model does, its sizes and ranges."""

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

        A ValueError: no card, data and licence; PermissionError, ConnectionError: the Hub refuses or is not
        reached.
        """
        beside = texts_beside(self.source, self.tensors())
        if not (card or (data and licence) or CARD_FILE in beside):
            raise ValueError(
                "this model has no card: state what it was trained on and what it may be used for, "
                "push_to_hub(..., data=..., licence=...), or pass card="
            )
        card = card or self._card(beside, repository, data, licence, scores)
        with TemporaryDirectory() as place:
            folder = self.save_pretrained(Path(place) / "model", card=card, licence=licence)
            return hub.upload(folder, repository, private=private, token=token)

    def _card(self, beside: Mapping[str, str], title: str, *stated: str | None) -> str:
        """The card that lies beside the weights, unless data, licence or scores are stated."""
        if CARD_FILE in beside and not any(stated):
            return beside[CARD_FILE]
        data, licence, scores = stated
        measured = " ".join(filter(None, [scores, _errors_in_words(beside.get(ERRORS_FILE, ""))]))
        parts = {"Trained on": data, "Scores": measured, "Licence": licence}
        paragraphs = [
            f"# {title}",
            self.description(),
            f'```python\nimport derender\n\nmodel = derender.load("{title}")\n```',
            *(f"**{name}**: {text or 'not stated'}" for name, text in parts.items()),
        ]
        return "\n\n".join(paragraphs) + "\n"


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
        stored = parse_json(errors, ErrorsFile)
    except ValueError:
        return ""
    median, high = stored.quantiles[50], stored.quantiles[99]
    return (
        f"Masked L1 of reconstructions of {stored.pictures:,} held-out images: median {median:.4f}, "
        f"99th percentile {high:.4f} (0..1, best 0)."
    )
