"""Saving and sharing a model: beside its weights a card, held-out errors and its split; the way to the Hub.

Leaves out what a model writes of itself, which the class that inherits `Shareable` says.
"""

from abc import abstractmethod
from collections.abc import Mapping
from pathlib import Path
from tempfile import TemporaryDirectory

from torch import Tensor

from derender.storage import hub
from derender.storage.atomic import new_folder
from derender.storage.card import CARD_FILE, model_card, with_metadata
from derender.storage.folder import ERRORS_FILE, SPLIT_FILE, texts_beside


class Shareable:
    """Saving, for a model that can write its own files.

    Attributes:
        source: the folder its weights were loaded from.
    """

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
        self,
        folder: str | Path,
        *,
        card: str | None = None,
        data: str | None = None,
        licence: str | None = None,
        scores: str | None = None,
        overwrite: bool = False,
    ) -> Path:
        """As ``save``, with what a shared model needs: a card (README.md), held-out errors and its split.

        They are those of the folder it was loaded from, as long as its weights are. Otherwise the card is
        ``card``, or is made of ``data`` (what it was trained on), ``licence`` and ``scores``.
        """
        beside = texts_beside(self.source, self.tensors())
        stated = {"data": data, "licence": licence, "scores": scores}
        card = card or self._card(beside, Path(folder).name, stated)
        with new_folder(folder, overwrite=overwrite) as temporary:
            self.write(temporary)
            (temporary / CARD_FILE).write_text(with_metadata(card, licence), encoding="utf-8")
            for name in {ERRORS_FILE, SPLIT_FILE} & beside.keys():
                (temporary / name).write_text(beside[name], encoding="utf-8")
        return Path(folder)

    def push_to_hub(
        self,
        repository: str,
        *,
        card: str | None = None,
        data: str | None = None,
        licence: str | None = None,
        scores: str | None = None,
        private: bool = False,
        token: str | None = None,
    ) -> str:
        """Upload the model to the Hugging Face Hub as ``save_pretrained`` writes it; returns its address.

        Raises:
            ValueError: it has no card, and its data and licence are not given.
            PermissionError, ConnectionError: the Hub refuses, or cannot be reached.
        """
        beside = texts_beside(self.source, self.tensors())
        if not (card or (data and licence) or CARD_FILE in beside):
            raise ValueError(
                "this model has no card: say what it was trained on and what it may be used for, "
                "push_to_hub(..., data=..., licence=...), or pass card="
            )
        card = card or self._card(beside, repository, {"data": data, "licence": licence, "scores": scores})
        with TemporaryDirectory() as place:
            folder = self.save_pretrained(Path(place) / "model", card=card, licence=licence)
            return hub.upload(folder, repository, private=private, token=token)

    def _card(self, beside: Mapping[str, str], title: str, stated: Mapping[str, str | None]) -> str:
        """The card that lies beside the weights, unless something else is stated about them."""
        if CARD_FILE in beside and not any(stated.values()):
            return beside[CARD_FILE]
        return model_card(title, self.description(), **stated, held_out=beside.get(ERRORS_FILE))
