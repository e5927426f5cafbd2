"""DINOv2-small: features learnt by others on 142 million images, for scale.

Source: Oquab et al., *DINOv2* (2023); weights facebook/dinov2-small (Apache-2.0), 22 million parameters, read
through transformers from the user's Hugging Face cache or a folder, as safetensors only. Nothing is ever
downloaded here. Images are enlarged to 224 pixels. Leaves out fine-tuning.
"""

from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import interpolate

from derender.baselines.model import PICKLES, WEIGHTS_FILE, BaselineModel, BaselineSettings, Images, optional

DEFAULT_ID = "facebook/dinov2-small"
IMAGENET_MEAN, IMAGENET_STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)


class Dinov2Settings(BaselineSettings):
    """Which weights, and the side to which images are enlarged: a multiple of the patches' 14 pixels."""

    weights: str = DEFAULT_ID
    enlarged: int = 224


class Dinov2(BaselineModel):
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

    def describe(self, images: Images) -> dict[str, Float[Tensor, "n _"]]:
        side = self.settings.enlarged
        large = interpolate(images, (side, side), mode="bicubic", align_corners=False, antialias=True)
        tokens = self.net((large.clamp(0, 1) - self.mean) / self.std).last_hidden_state
        return {"class": tokens[:, 0], "patches": tokens[:, 1:].mean(dim=1)}


def open_dinov2(name: str, source: str | None, image_size: int, seed: int) -> Dinov2:
    """See `registry.open_baseline`."""
    return load_dinov2(source or DEFAULT_ID, image_size=image_size)


def load_dinov2(source: str = DEFAULT_ID, *, image_size: int = 64, enlarged: int = 224) -> Dinov2:
    """The network with its published weights, ready to embed.

    Args:
        source: an id in the Hugging Face cache, or a folder with config.json and model.safetensors.
        image_size: side of its input images.
        enlarged: side to which it enlarges them.

    Raises:
        ValueError: there are no weights, or they are a pickle, or of another kind of network.
    """
    if Path(source).suffix.lower() in PICKLES:
        raise ValueError(
            f"{source} is a pickle, which can run code when it is read: give a folder with model.safetensors"
        )
    if Path(source).is_dir() and not (Path(source) / WEIGHTS_FILE).is_file():
        raise ValueError(  # an index of shards could name files outside the folder (CVE-2026-75104)
            f"{source} has no {WEIGHTS_FILE}: give a folder with config.json and the weights in that one "
            "file; weights in several parts and pickles are not opened"
        )
    library = optional("transformers", "the baseline dinov2")
    try:
        tree, _ = library.PretrainedConfig.get_config_dict(source, local_files_only=True)
        if tree.get("model_type") != "dinov2":
            raise ValueError(f"{source} is a {tree.get('model_type')}, expected a dinov2")
        net, info = library.Dinov2Model.from_pretrained(
            source, local_files_only=True, use_safetensors=True, output_loading_info=True
        )
    except OSError as error:
        if Path(source).is_dir():
            raise ValueError(
                f"{source} holds no config.json and model.safetensors that can be read "
                f"({str(error).splitlines()[0]}); pickles are not opened"
            ) from error
        raise ValueError(
            f"the weights {source} are not in the Hugging Face cache and nothing is downloaded here: run "
            f"'hf download {source}' once where there is a network, or name their folder"
        ) from error
    missing = sorted(info["missing_keys"])
    if missing:
        raise ValueError(f"{source} is of another architecture: it has no {missing[0]!r}")
    model = Dinov2(Dinov2Settings(image_size=image_size, weights=source, enlarged=enlarged), net)
    return model.eval().requires_grad_(False)
