"""Stages 1 to 4 joined: pictures in, scenes and features out, pictures rendered again.

Source: Klinghoffer et al., ECCV 2022, Sec. 3; networks and scene of unsup3d (Wu et al., CVPR 2020).
Training lives in training/, scores in evaluation/; the model knows neither.
"""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn

from derender.data import check_pictures, refuse_not_finite
from derender.networks import FACTORS, Factor, NetworkSettings
from derender.networks.confidence import Confidence, ConfidenceNet
from derender.networks.unet import pixel_decoder
from derender.networks.unsup3d import read_checkpoint
from derender.postprocess.fitting import STEPS, Fitted, Fitting, coordinates_of
from derender.postprocess.whitening import Whitening
from derender.presets import MODEL_PRESETS, ModelSettings, named_preset
from derender.render import Rendering, render_scene
from derender.scene import Scene
from derender.scene.ranges import SceneRanges
from derender.storage import hub
from derender.storage.atomic import atomic_folder
from derender.storage.card import CARD_FILE, model_card, with_metadata
from derender.storage.folder import (
    CONFIG_FILE,
    ERRORS_FILE,
    FITTING_FILE,
    PRETRAINED,
    SPLIT_FILE,
    WEIGHTS_FILE,
    WHITENING_FILE,
    bundled_models,
    check_shapes,
    model_folder,
    read_config,
    texts_beside,
    write_config,
)
from derender.storage.tensors import read_tensors, write_tensors

Renderer = Callable[[Scene, float], Rendering]

__all__ = [
    "CONFIG_FILE",
    "ERRORS_FILE",
    "FITTING_FILE",
    "PRETRAINED",
    "WEIGHTS_FILE",
    "WHITENING_FILE",
    "Derenderer",
    "Renderer",
    "bundled_models",
    "load",
    "model_folder",
]


class Derenderer(nn.Module):
    """Takes pictures of one kind of thing apart into geometry, albedo, light and camera.

    Args:
        settings: sizes of the networks and ranges of the scene.
        factors: declared rows, by default the paper's four.
        renderer: makes pictures of scenes, given the horizontal field of view in degrees.
    """

    def __init__(
        self,
        settings: ModelSettings | None = None,
        factors: Sequence[Factor] = FACTORS,
        renderer: Renderer = render_scene,
    ):
        super().__init__()
        self.settings = settings or ModelSettings()
        self.factors = tuple(factors)
        self.renderer = renderer
        self.nets = nn.ModuleDict(
            {factor.name: factor.build(self.settings.network) for factor in self.factors}
        )
        self.nets["confidence"] = ConfidenceNet(self.settings.network)
        taught = self.settings.network.unet_decoder
        self.unet_decoder = pixel_decoder(self.settings.network) if taught else None  # training/unets.py
        self.whitening: Whitening | None = None  # fitted after training (training/whitening.py)
        self.fitting: Fitting | None = None  # made after training (training/fitting.py)
        self.source: Path | None = None  # the folder these weights were loaded from

    @classmethod
    def from_preset(cls, name: str, *, seed: int | None = None, **network: Any) -> "Derenderer":
        """An untrained model by preset name; keywords change network sizes (``image_size=128``).

        With ``seed`` the initial weights are reproducible and torch's global generator is left as it was.
        """
        preset = named_preset(name, MODEL_PRESETS)
        sizes = NetworkSettings(**{**preset.network.model_dump(), **network})
        settings = preset.model_copy(update={"network": sizes})
        return cls(settings) if seed is None else cls.seeded(settings, seed)

    @classmethod
    def seeded(cls, settings: ModelSettings, seed: int, **rows: Any) -> "Derenderer":
        """An untrained model with reproducible weights; torch's global generator is left as it was."""
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            return cls(settings, **rows)

    @property
    def image_size(self) -> int:
        """Side of the pictures the networks take, in pixels."""
        return self.settings.network.image_size

    @property
    def fov_deg(self) -> float:
        """Horizontal field of view of every picture, in degrees."""
        return self.settings.ranges.fov_deg

    @property
    def device(self) -> torch.device:
        return next(self.parameters()).device

    @classmethod
    def from_unsup3d(cls, file: str | Path, ranges: SceneRanges | None = None) -> "Derenderer":
        """A model with the weights of an unsup3d checkpoint (``.pth``); nothing in the file is run.

        Sizes are read off the file; ``ranges`` are what it was trained with, by default unsup3d's for faces
        and cats. Without a confidence net in the file, which only training asks for, ours is fresh.
        """
        network, weights = read_checkpoint(file)
        model = cls(ModelSettings(network=network, ranges=ranges or SceneRanges()))
        model.load_state_dict(model.state_dict() | weights)
        return model.eval().requires_grad_(False)

    def embed(self, images: Float[Tensor, "n 3 h w"]) -> dict[str, Float[Tensor, "n code"]]:
        """One feature per factor for pictures in 0..1, by name: whitened if fitted, else its code.

        Coordinates of the fitted scene follow in a model whose fitting makes steps.
        """
        refuse_not_finite(images)
        if self.whitening is None and not self.fits_scenes:
            return self.encode(images)
        return self.features(self.read(images))

    def read(self, images: Float[Tensor, "n 3 h w"]) -> dict[str, Float[Tensor, "n _"]]:
        """All that each encoder says of pictures in 0..1: its code, then its last spatial features.

        Where features are made of it, what it says of the mirror image follows. The fitted scene's
        coordinates, where they are part of features, have keys of their own (`coordinates_of`).
        """
        check_pictures(images, self.image_size)
        found = {factor.name: self.read_factor(factor.name, images) for factor in self.factors}
        if self.fits_scenes:
            fitted = self._fitted(images, self.decode(self.codes(found))).coordinates
            found |= {coordinates_of(name): value for name, value in fitted.items()}
        return found

    def read_factor(self, name: str, images: Float[Tensor, "n 3 h w"]) -> Float[Tensor, "n _"]:
        """``read`` for one factor."""
        own = self.nets[name].read(images)  # type: ignore[operator]
        if not self.mirrors(name):
            return own
        return torch.cat([own, self.nets[name].read(images.flip(-1))], dim=1)  # type: ignore[operator]

    def mirrors(self, name: str) -> bool:
        """Whether a factor's feature is made of a picture and its mirror image."""
        return self.whitening is not None and name in self.whitening.mirrored

    def codes(self, readings: Mapping[str, Float[Tensor, "n _"]]) -> dict[str, Float[Tensor, "n code"]]:
        """The codes that readings begin with: what ``encode`` gives for the pictures they come from."""
        size, names = self.settings.network.code_size, {factor.name for factor in self.factors}
        return {name: row[:, :size] for name, row in readings.items() if name in names}

    def features(self, readings: Mapping[str, Float[Tensor, "n _"]]) -> dict[str, Float[Tensor, "n code"]]:
        """The features that belong to readings: what ``embed`` gives for the pictures they come from.

        Raises:
            ValueError: there are codes where features are made of whole readings.
        """
        own = {} if self.whitening is None else self.whitening(readings)
        found = self.codes(readings) | own
        if self.fitting is None:
            return found
        fitted = {name: readings[coordinates_of(name)] for name in found if coordinates_of(name) in readings}
        return found | {
            name: torch.cat([found[name], self.fitting.features(value)], dim=1)
            for name, value in fitted.items()
        }

    def encode(self, images: Float[Tensor, "n 3 h w"]) -> dict[str, Float[Tensor, "n code"]]:
        """One code per factor for pictures in 0..1, by factor name: what ``decode`` takes."""
        check_pictures(images, self.image_size)
        return {factor.name: self.nets[factor.name].encode(images) for factor in self.factors}  # type: ignore[operator]

    def decode(self, codes: Mapping[str, Float[Tensor, "n code"]]) -> Scene:
        """The scene that codes stand for."""
        return Scene.from_parameters(
            {
                factor.parameter: factor.to_parameter(
                    self.nets[factor.name].decode(codes[factor.name]),  # type: ignore[operator]
                    self.settings.ranges,
                )
                for factor in self.factors
            }
        )

    def decompose(self, images: Float[Tensor, "n 3 h w"]) -> Scene:
        """Geometry, albedo, light and camera of pictures in 0..1."""
        refuse_not_finite(images)
        return self.decode(self.encode(images))

    @property
    def fits_scenes(self) -> bool:
        """Whether features are made of fitted scenes, too."""
        return self.fitting is not None and self.fitting.settings.steps > 0

    def fit_scenes(self, images: Float[Tensor, "n 3 h w"], steps: int = STEPS) -> Fitted:
        """Scenes of pictures in 0..1, fitted to them by rendering from what ``decompose`` says on.

        Slower than ``decompose`` by a hundred times, nearer to the picture, and right in light and views in
        which encoders were not trained.

        Raises:
            ValueError: the model has not been given what this needs (``derender whiten``).
        """
        scene = self.decompose(images)
        if self.fitting is None:
            raise ValueError(
                "this model cannot fit scenes yet: derender whiten --model MODEL --data PICTURES --out NEW "
                "makes a copy that can"
            )
        return self._fitted(images, scene, steps)

    def _fitted(self, images: Tensor, scene: Scene, steps: int | None = None) -> Fitted:
        assert self.fitting is not None
        return self.fitting.fit(images, scene, self.render, steps)

    def render(self, scene: Scene) -> Rendering:
        """Pictures of scenes, with the model's field of view."""
        return self.renderer(scene, self.fov_deg)

    def reconstruct(self, images: Float[Tensor, "n 3 h w"]) -> Rendering:
        """Take pictures apart and render them again."""
        return self.render(self.decompose(images))

    def confidence(self, images: Float[Tensor, "n 3 h w"]) -> Confidence:
        """Where the reconstruction is expected to fail (used in training)."""
        check_pictures(images, self.image_size)
        return self.nets["confidence"](images)

    def mirror(self, scene: Scene) -> Scene:
        """The flipped twin of a scene: its maps mirrored left to right, everything else as it is."""
        return scene.with_parameters(
            **{f.parameter: scene.parameters[f.parameter].flip(-1) for f in self.factors if f.mirrored}
        )

    def save(self, folder: str | Path, *, overwrite: bool = False) -> Path:
        """Write settings and weights to ``folder``; complete or not at all."""
        folder = Path(folder)
        if folder.exists() and not overwrite:
            raise FileExistsError(f"{folder} exists already: choose another folder or pass overwrite=True")
        with atomic_folder(folder) as temporary:
            self._write(temporary)
        return folder

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
        """As ``save``, with what a model is given away with: a card (README.md), its held-out errors and the
        split of its training.

        They are those of the folder it was loaded from, as long as its weights are. Otherwise the card is
        ``card``, or is made of ``data`` (what it was trained on), ``licence`` and ``scores``.
        """
        folder = Path(folder)
        if folder.exists() and not overwrite:
            raise FileExistsError(f"{folder} exists already: choose another folder or pass overwrite=True")
        beside = self._beside()
        card = card or self._card(beside, folder.name, data=data, licence=licence, scores=scores)
        with atomic_folder(folder) as temporary:
            self._write(temporary)
            (temporary / CARD_FILE).write_text(with_metadata(card, licence), encoding="utf-8")
            for name in (ERRORS_FILE, SPLIT_FILE):
                if name in beside:
                    (temporary / name).write_text(beside[name], encoding="utf-8")
        return folder

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
        """Put the model on the Hugging Face Hub as ``save_pretrained`` writes it; gives its address.

        Raises:
            ValueError: nobody says what it was trained on and under what licence.
            PermissionError, ConnectionError: the Hub refuses, or cannot be reached.
        """
        beside = self._beside()
        if not (card or (data and licence) or CARD_FILE in beside):
            raise ValueError(
                "this model has no card: say what it was trained on and what it may be used for, "
                "push_to_hub(..., data=..., licence=...), or pass card="
            )
        card = card or self._card(beside, repository, data=data, licence=licence, scores=scores)
        with TemporaryDirectory() as place:
            folder = self.save_pretrained(Path(place) / "model", card=card, licence=licence)
            return hub.upload(folder, repository, private=private, token=token)

    @classmethod
    def from_pretrained(cls, source: str | Path, **rows: Any) -> "Derenderer":
        """`load` under the name that users of the Hub know."""
        return load(source, **rows)

    def _write(self, folder: Path) -> None:
        write_tensors(self.state_dict(), folder / WEIGHTS_FILE)
        write_config(folder, [factor.name for factor in self.factors], self.settings.model_dump(mode="json"))
        if self.whitening is not None:
            self.whitening.save(folder / WHITENING_FILE)
        if self.fitting is not None:
            self.fitting.save(folder / FITTING_FILE)

    def _card(self, beside: Mapping[str, str], title: str, **told: str | None) -> str:
        """The card that lies beside the weights, unless something else is told of them."""
        if CARD_FILE in beside and not any(told.values()):
            return beside[CARD_FILE]
        return model_card(title, self.settings.description(), **told, held_out=beside.get(ERRORS_FILE))

    def _beside(self) -> dict[str, str]:
        """Card and held-out errors of the folder it was loaded from, if its weights still are those."""
        own = self.state_dict()
        for part in (self.whitening, self.fitting):
            own |= {} if part is None else part.tensors()
        return texts_beside(self.source, own)


def load(
    source: str | Path,
    *,
    device: str | torch.device = "cpu",
    factors: Sequence[Factor] = FACTORS,
    renderer: Renderer = render_scene,
) -> Derenderer:
    """A trained model, ready for use: evaluation mode, parameters without gradient.

    Args:
        source: a run folder, a saved folder, the name of a model that comes with derender (`bundled_models`),
            or a Hugging Face Hub id ("owner/name", downloaded and cached).
        device: where to put it.
        factors: the rows the model was made with, if not the paper's four.
        renderer: the renderer it was made with, if not the project's own.

    Raises:
        FileNotFoundError: nothing is there.
        ValueError: what is there is damaged, or made with other factors or by a newer version.
    """
    folder = model_folder(source)
    config = read_config(folder)
    names = [factor.name for factor in factors]
    if config["factors"] != names:
        raise ValueError(
            f"{folder} holds factors {', '.join(config['factors'])}, asked for {', '.join(names)}: "
            "pass its rows as factors="
        )
    try:
        settings = ModelSettings.model_validate(config["settings"])
        weights = read_tensors(folder / WEIGHTS_FILE)
        with torch.device("meta"):  # sizes are compared before memory is taken for what the file only claims
            check_shapes(weights, Derenderer(settings, factors, renderer).state_dict())
        model = Derenderer(settings, factors, renderer)
        model.load_state_dict(weights)
        if (folder / WHITENING_FILE).is_file():
            model.whitening = Whitening.load(folder / WHITENING_FILE)
        if (folder / FITTING_FILE).is_file():
            model.fitting = Fitting.load(folder / FITTING_FILE)
            model.fitting.check_size(model.image_size)
    except (RuntimeError, ValueError) as error:
        raise ValueError(
            f"{folder} is damaged ({str(error).splitlines()[0]}): copy or train the model again"
        ) from error
    model.source = folder
    return model.to(device).eval().requires_grad_(False)
