"""DINOv2-small: a vision transformer that others trained.

Source: Oquab et al., *DINOv2* (2023); weights facebook/dinov2-small (Apache-2.0), 22 million parameters,
learnt on 142 million images. They are read through transformers from the user's Hugging Face cache or a
folder, as safetensors only. Nothing is ever downloaded here.
"""

from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import interpolate

from derender.baselines import model as base
from derender.storage.bounded import first_line
from derender.storage.places import optional

WEIGHTS = "facebook/dinov2-small"
IMAGENET_MEAN, IMAGENET_STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)


class Dinov2Settings(base.BaselineSettings):
    """Which weights, and the side to which images are enlarged: a multiple of the patches' 14 pixels."""

    weights: str = WEIGHTS
    enlarged: int = 224


class Dinov2(base.BaselineModel):
    """A vision transformer. Features: ``class`` (the class token) and ``patches`` (the mean patch)."""

    name, settings_type = "dinov2", Dinov2Settings
    features = ("class", "patches")
    settings: Dinov2Settings
    mean: Tensor
    std: Tensor

    def __init__(self, settings: Dinov2Settings, net: Any):
        super().__init__(settings)
        self.net = net
        self.register_buffer("mean", torch.tensor(IMAGENET_MEAN).view(1, 3, 1, 1), persistent=False)
        self.register_buffer("std", torch.tensor(IMAGENET_STD).view(1, 3, 1, 1), persistent=False)

    def describe(self, images: base.Images) -> base.Features:
        side = self.settings.enlarged
        large = interpolate(images, (side, side), mode="bicubic", align_corners=False, antialias=True)
        tokens = self.net((large.clamp(0, 1) - self.mean) / self.std).last_hidden_state
        return {"class": tokens[:, 0], "patches": tokens[:, 1:].mean(dim=1)}

    @classmethod
    def open(
        cls, source: str | Path | None = None, *, image_size: int | None = None, seed: int = 0
    ) -> "Dinov2":
        """The network with its published weights, ready to embed; ``seed`` is ignored.

        ``source`` is an id in the Hugging Face cache, or a folder with config.json and model.safetensors.
        Missing weights, a pickle, or another kind of network are a ValueError.
        """
        source = WEIGHTS if source is None else str(source)
        settings, folder = Dinov2Settings(image_size=image_size or 64, weights=source), Path(source)
        # an index of shards could name files outside the folder (CVE-2026-75104)
        in_parts = folder.is_dir() and not (folder / base.WEIGHTS_FILE).is_file()
        if in_parts or folder.suffix.lower() in base.PICKLES:
            fix = "give a folder with config.json and the weights in that one file"
            why = "Weights in parts, and pickles, which can run code, are not opened"
            raise ValueError(f"{source} has no {base.WEIGHTS_FILE}: {fix}. {why}")
        library = optional("transformers", "the baseline dinov2")
        try:
            tree, _ = library.PretrainedConfig.get_config_dict(source, local_files_only=True)
            if tree.get("model_type") != "dinov2":
                raise ValueError(f"{source} is a {tree.get('model_type')}, expected a dinov2")
            net, info = library.Dinov2Model.from_pretrained(
                source, local_files_only=True, use_safetensors=True, output_loading_info=True
            )
        except OSError as error:
            why = "are not in the Hugging Face cache or cannot be read, and nothing is downloaded here"
            fix = f"run 'hf download {source}' once where there is a network, or name their folder"
            raise ValueError(f"the weights {source} {why} ({first_line(error)}): {fix}") from error
        if missing := sorted(info["missing_keys"]):
            raise ValueError(f"{source} is of another architecture: it has no {missing[0]!r}")
        return cls(settings, net).eval().requires_grad_(False)
