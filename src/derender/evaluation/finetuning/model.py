"""A model with a head: what joint training trains, and how it lies in a folder."""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor, nn

from derender.evaluation.linear_head import probabilities
from derender.model import Derenderer, load
from derender.storage.atomic import atomic_folder
from derender.storage.tensors import read_tensors, write_tensors

HEAD_FILE, HEAD_CONFIG_FILE = "head.safetensors", "head.json"


class TargetHead(nn.Module):
    """One linear layer on standardised features: every dimension with mean 0 and variance 1.

    Attributes:
        factors: whose features it reads, side by side.
        kind: "labels" (yes or no, each apart) or "classes" (one of several).
        names: of the labels, or of the classes.
    """

    def __init__(self, factors: Sequence[str], width: int, kind: str, names: Sequence[str]):
        super().__init__()
        self.factors, self.kind, self.names = tuple(factors), kind, tuple(names)
        self.standardise = nn.BatchNorm1d(width, affine=False)
        self.linear = nn.Linear(width, len(self.names))

    def forward(self, codes: Mapping[str, Tensor]) -> Float[Tensor, "n outputs"]:
        """Logits from features by factor."""
        return self.linear(self.standardise(torch.cat([codes[name].float() for name in self.factors], dim=1)))


class FinetunedModel(nn.Module):
    """Our model and a head on its features."""

    def __init__(self, model: Derenderer, head: TargetHead):
        super().__init__()
        self.model, self.head = model, head

    @property
    def device(self) -> torch.device:
        return self.model.device

    @property
    def image_size(self) -> int:
        return self.model.image_size

    def answer(self, images: Float[Tensor, "n 3 h w"]) -> Float[Tensor, "n outputs"]:
        """Probabilities for pictures in 0..1: of each label, or of every class."""
        return probabilities(self.head(self.model.encode(images)), self.head.kind)

    def save(self, folder: str | Path, *, overwrite: bool = False) -> Path:
        """Write a folder that `derender.load` takes, the head beside the model; complete or not at all."""
        folder = Path(folder)
        if folder.exists() and not overwrite:
            raise FileExistsError(f"{folder} exists already: choose another folder or pass overwrite=True")
        about = {"factors": self.head.factors, "kind": self.head.kind, "names": self.head.names}
        with atomic_folder(folder) as temporary:
            self.model.save(temporary, overwrite=True)
            write_tensors(self.head.state_dict(), temporary / HEAD_FILE)
            (temporary / HEAD_CONFIG_FILE).write_text(json.dumps(about, indent=1))
        return folder


def load_finetuned(source: str | Path, *, device: str | torch.device = "cpu") -> FinetunedModel:
    """A run folder of `derender finetune`, or its ``model``, ready to answer.

    Raises:
        FileNotFoundError: there is no model, or none with a head.
        ValueError: it is damaged.
    """
    model, folder = load(source, device=device), Path(source)
    folder = folder if (folder / HEAD_FILE).is_file() else folder / "model"
    if not (folder / HEAD_FILE).is_file():
        raise FileNotFoundError(f"{source} has no head ({HEAD_FILE}): give a run made by 'derender finetune'")
    try:
        about = json.loads((folder / HEAD_CONFIG_FILE).read_text())
        width = model.settings.network.code_size * len(about["factors"])
        head = TargetHead(about["factors"], width, about["kind"], about["names"])
        head.load_state_dict(read_tensors(folder / HEAD_FILE))
    except (OSError, ValueError, KeyError, TypeError, RuntimeError) as error:
        raise ValueError(f"the head in {folder} is damaged: copy or train the model again") from error
    return FinetunedModel(model, head.to(device)).eval().requires_grad_(False)
