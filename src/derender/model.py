"""Stages 1 to 4 joined: images to scenes and features, scenes to images.

Source: Klinghoffer et al., ECCV 2022, Sec. 3; networks and scene of unsup3d (Wu et al., CVPR 2020). Training
lives in training/, scores in evaluation/, saving in storage/; the model knows none of them.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn

from derender.data import GivenImages, as_batch, check_images
from derender.networks import Factor, NetworkSettings
from derender.networks.decoders import Confidence, ConfidenceNet
from derender.networks.encoders import pixel_decoder
from derender.networks.unsup3d import read_checkpoint
from derender.postprocess import Features
from derender.postprocess.embedding import EmbeddingModel
from derender.presets import MODEL_PRESETS, ModelSettings, named_preset
from derender.render import Rendering
from derender.renderers import Render, as_renderer, recorded_renderer
from derender.scene import Scene
from derender.scene.ranges import SceneRanges
from derender.storage import folder as files
from derender.storage.places import model_folder
from derender.storage.sharing import Shareable
from derender.storage.tensors import write_tensors


class Derenderer(EmbeddingModel, Shareable):
    """Decomposes images of one kind of object into geometry, albedo, light, camera and what a renderer adds.

    Args:
        settings: sizes of the networks, ranges of the scene, name of the renderer.
        factors: declared rows, by default those of the renderer.
        renderer: by name or itself, in place of the settings' one; or a function beside its ``factors``.
        features: how features are made of encoder activations; by default they are the codes.
    """

    def __init__(
        self, settings: ModelSettings | None = None, factors: Sequence[Factor] | None = None,
        renderer: str | Render | None = None, features: Features | None = None,
    ):  # fmt: skip
        super().__init__(features)
        settings = settings or ModelSettings()
        self.renderer = as_renderer(renderer, settings.renderer)
        self.settings = settings.model_copy(update={"renderer": self.renderer.name})
        self.factors = tuple(self.renderer.all_factors if factors is None else factors)
        network = self.settings.network
        self.nets = nn.ModuleDict({factor.name: factor.build(network) for factor in self.factors})
        self.nets["confidence"] = ConfidenceNet(network)
        self.unet_decoder = pixel_decoder(network) if network.unet_decoder else None  # training/unets.py

    @classmethod
    def from_preset(
        cls, name: str, *, seed: int | None = None, renderer: str | Render | None = None, **network: Any
    ) -> "Derenderer":
        """An untrained model by preset name; keywords change network sizes (``image_size=128``).

        With ``seed`` the initial weights are reproducible and torch's global generator is left as it was.
        """
        preset = named_preset(name, MODEL_PRESETS)
        sizes = NetworkSettings(**{**preset.network.model_dump(), **network})
        return cls.seeded(preset.model_copy(update={"network": sizes}), seed, renderer=renderer)

    @classmethod
    def seeded(cls, settings: ModelSettings, seed: int | None, **rows: Any) -> "Derenderer":
        """An untrained model with reproducible weights; torch's global generator is left as it was."""
        with torch.random.fork_rng(devices=[], enabled=seed is not None):
            if seed is not None:
                torch.manual_seed(seed)
            return cls(settings, **rows)

    @classmethod
    def from_unsup3d(cls, file: str | Path, ranges: SceneRanges | None = None) -> "Derenderer":
        """A model with the weights of an unsup3d checkpoint (``.pth``); no code in the file is run.

        Sizes come from the file; ``ranges`` are those of its training, by default unsup3d's for faces and
        cats. If the file has no confidence net, which only training needs, a fresh one is used.
        """
        network, weights = read_checkpoint(file)
        model = cls(ModelSettings(network=network, ranges=ranges or SceneRanges()))
        model.load_state_dict(model.state_dict() | weights)
        return model.eval().requires_grad_(False)

    @classmethod
    def from_pretrained(cls, source: str | Path, **rows: Any) -> "Derenderer":
        """`load` under the name that users of the Hub know."""
        return load(source, **rows)

    @property
    def fov_deg(self) -> float:
        """Horizontal field of view of every image, in degrees."""
        return self.settings.ranges.fov_deg

    def encode(self, images: Float[Tensor, "n 3 h w"]) -> dict[str, Float[Tensor, "n code"]]:
        """One code per factor for images in 0..1, by factor name: what ``decode`` takes."""
        check_images(images, self.image_size)
        return {f.name: self.nets[f.name].encoder(images) for f in self.factors}

    def decode(self, codes: Mapping[str, Float[Tensor, "n code"]]) -> Scene:
        """The scene that codes stand for."""
        ranges = self.settings.ranges
        raw = {f.name: self.nets[f.name].decoder(codes[f.name]) for f in self.factors}
        return Scene.from_parameters({f.parameter: f.to_parameter(raw[f.name], ranges) for f in self.factors})

    def decompose(self, images: GivenImages) -> Scene:
        """The scenes of images, (N, 3, S, S) in 0..1 or what `as_batch` takes, found in `framed` ones."""
        framed, crops = self.framed(as_batch(images, self.image_size, self.device))
        return self.placed(self.balanced(self.decode(self.encode(framed))), crops)

    def render(self, scene: Scene) -> Rendering:
        """Images of scenes, with the model's field of view."""
        return self.renderer(scene, self.fov_deg)

    def reconstruct(self, images: Float[Tensor, "n 3 h w"]) -> Rendering:
        """Decompose images and render them again."""
        return self.render(self.decompose(images))

    def confidence(self, images: Float[Tensor, "n 3 h w"]) -> Confidence:
        """Where the reconstruction is expected to fail (used in training)."""
        check_images(images, self.image_size)
        return self.nets["confidence"](images)

    def mirror(self, scene: Scene) -> Scene:
        """The flipped twin of a scene: its maps mirrored left to right, everything else as it is."""
        names = (factor.parameter for factor in self.factors if factor.mirrored)
        return scene.with_parameters(**{name: scene.parameters[name].flip(-1) for name in names})

    def write(self, folder: Path) -> None:
        write_tensors(self.state_dict(), folder / files.WEIGHTS_FILE)
        files.write_config(folder, [factor.name for factor in self.factors], self.settings)
        self.features.save(folder)

    def tensors(self) -> dict[str, Tensor]:
        return self.state_dict() | self.features.tensors()


def load(
    source: str | Path, *, device: str | torch.device = "cpu", factors: Sequence[Factor] | None = None,
    renderer: str | Render | None = None,
) -> Derenderer:  # fmt: skip
    """A trained model, ready for use: evaluation mode, parameters without gradient.

    Args:
        source: a run folder, a saved folder, the name of a bundled model, or a Hugging Face Hub id.
        device: where to put it; "auto" is the graphics card if there is one.
        factors, renderer: what it was made with, if its ``config.json`` cannot tell. A user's module that a
            model of the Hub names is imported only where it is given here.

    Raises:
        FileNotFoundError: there is no model.
        ValueError: the model is damaged, of other factors, another renderer or a newer version.
    """
    folder = model_folder(source)
    config = files.read_config(folder)
    with files.naming_damage(folder):
        settings = ModelSettings.model_validate(config["settings"])
    renderer = recorded_renderer(settings.renderer, renderer, source)
    factors = renderer.all_factors if factors is None else factors
    if (names := [factor.name for factor in factors]) != config["factors"]:
        both = f"{', '.join(config['factors'])}, asked for {', '.join(names)}"
        raise ValueError(f"{folder} holds factors {both}: pass its rows as factors=")
    with files.naming_damage(folder):
        model = files.read_weights(folder, lambda: Derenderer(settings, factors, renderer))
        model = model.with_features(Features.load(folder, model.image_size))
    model.source = folder
    device = ("cuda" if torch.cuda.is_available() else "cpu") if device == "auto" else device
    return model.to(device).eval().requires_grad_(False)
