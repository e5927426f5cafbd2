"""A model's features: encoder activations, and what `Features` makes of them; scenes fitted per image.

Rounding depends on the shape of a batch and on how threads share it, and many steps downhill magnify it. So
networks see images by fours, one thread a portion, and a scene is the same whatever stands beside it.
"""

import copy
import math
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TypeVar

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn.functional import adaptive_avg_pool2d, avg_pool2d, conv2d, pad

from derender.data import GivenImages, as_batch, check_images
from derender.networks import Factor
from derender.networks.encoders import reduced
from derender.postprocess.fitting import STEPS, Fitted, Fitting, coordinates_of
from derender.postprocess.framing import Framing
from derender.postprocess.whitening import Whitening
from derender.presets import ModelSettings
from derender.render import Rendering, unwarp
from derender.scene import Scene
from derender.scene.brightness import BrightnessPrior
from derender.scene.camera import constant
from derender.scene.crop import back, crop_images, crop_scene
from derender.storage.places import FITTING_FILE, WHITENING_FILE

FEW, MOST = 4, 64  # images in one call of a network, and in a portion: large ones take a third less time
CELLS = 32  # of gradient directions along each side
BLUR_PX, SCALE = 0.75, 0.2  # blur before differences; near the variation of activations (development halves)
_DARK = 1 / 510  # half a grey level: shorter gradients are noise
HISTOGRAM_CELLS, ORIENTATIONS = 16, 12  # of histograms of gradients: along each side, and in each
HISTOGRAMS = HISTOGRAM_CELLS**2 * ORIENTATIONS
Model = TypeVar("Model", bound="EmbeddingModel")
Images = Float[Tensor, "n 3 h w"]
Crops = Float[Tensor, "n 2 3"]
Rows = Float[Tensor, "n _"]
Codes = Mapping[str, Float[Tensor, "n code"]]


@dataclass(frozen=True)
class Features:
    """Post-processing of encoder activations: without whitening a feature is the encoder output (the code).

    Coordinates of scenes that the fitting finds follow, unless it makes 0 steps.
    """

    whitening: Whitening | None = None
    fitting: Fitting | None = None

    @property
    def fits_scenes(self) -> bool:
        """Whether features hold coordinates of fitted scenes."""
        return self.fitting is not None and self.fitting.settings.steps > 0

    def mirrors(self, factor: str) -> bool:
        """Whether a factor's feature is made of an image and of its mirror image."""
        return self.whitening is not None and factor in self.whitening.mirrored

    def turns(self, factor: str) -> bool:
        """Whether a factor's feature is made of the image's canonical view."""
        return self.whitening is not None and factor in self.whitening.canonical

    def framing(self, factor: str) -> Framing | None:
        """What finds the crops that a factor's feature is made of, if it is."""
        return self.whitening.framing if self.whitening is not None and self.mirrors(factor) else None

    def __call__(self, codes: Codes, activations: Mapping[str, Rows]) -> dict[str, Rows]:
        """Features by factor, of encoder outputs and activations; codes alone may be a ValueError."""
        features = {**codes, **(self.whitening(activations) if self.whitening is not None else {})}
        if self.fitting is not None:
            for name in [name for name in features if coordinates_of(name) in activations]:
                fitted = self.fitting.features(activations[coordinates_of(name)])
                features[name] = torch.cat([features[name], fitted], dim=1)
        return features

    def required_fitting(self, model: str = "this model") -> Fitting:
        """The fitting, or an error that names how to get one."""
        if self.fitting is None:
            name = model if model != "this model" else "MODEL"
            fix = f"derender whiten --model {name} IMAGES --out NEW makes a copy that can"
            raise ValueError(f"{model} cannot optimise scenes per image yet: {fix}")
        return self.fitting

    def with_steps(self, steps: int) -> "Features":
        """The same with so many steps of fitting per image; 0: features are feed-forward only."""
        if steps < 0:
            raise ValueError(f"fit_steps must be 0 or more, got {steps}")
        return replace(self, fitting=None if self.fitting is None else self.fitting.with_steps(steps))

    def tensors(self) -> dict[str, Tensor]:
        """All tensors that ``save`` writes, by name."""
        parts = (part for part in (self.whitening, self.fitting) if part is not None)
        return {name: value for part in parts for name, value in part.named_buffers()}

    def save(self, folder: Path) -> None:
        """Write a file for each part there is into a saved model's folder."""
        if self.whitening is not None:
            self.whitening.save(folder / WHITENING_FILE)
        if self.fitting is not None:
            self.fitting.save(folder / FITTING_FILE)

    @classmethod
    def load(cls, folder: Path, image_size: int) -> "Features":
        """Read the parts in a saved model's folder; damage or maps of another size are a ValueError."""
        whitening, fitting = folder / WHITENING_FILE, folder / FITTING_FILE
        return cls(
            Whitening.load(whitening) if whitening.is_file() else None,
            Fitting.load(fitting, image_size) if fitting.is_file() else None,
        )


class EmbeddingModel(nn.Module):
    """Images to features; ``features`` (whitening, fitting) are exchanged by ``with_features``."""

    factors: tuple[Factor, ...]
    nets: Any  # a `FactorNet` for each, by name, in an `nn.ModuleDict`
    settings: ModelSettings
    encode: Callable[[Images], dict[str, Float[Tensor, "n code"]]]
    decode: Callable[[Codes], Scene]
    render: Callable[[Scene], Rendering]

    def __init__(self, features: Features | None):
        super().__init__()
        features = features or Features()
        self.whitening, self.fitting = features.whitening, features.fitting

    def to(self, *args: Any, **kwargs: Any) -> Any:
        """As `torch.nn.Module.to`; a graphics card that is not there is a ValueError."""
        try:
            return super().to(*args, **kwargs)
        except (AssertionError, RuntimeError) as problem:
            if "cuda" in str((*args, *kwargs.values())) and not torch.cuda.is_available():
                raise ValueError("no CUDA device here: leave the model on 'cpu'") from problem
            if "device type" in str(problem):
                raise ValueError(f"unknown device: give 'cpu' or 'cuda', got {args or kwargs}") from problem
            raise

    @property
    def image_size(self) -> int:
        """Side of the images the networks take, in pixels."""
        return self.settings.network.image_size

    @property
    def device(self) -> torch.device:
        return next(self.parameters()).device

    def balanced(self, scene: Scene) -> Scene:
        """A decoded scene whose brightness the model's prior, if any, shares between albedo and light."""
        prior = self.settings.brightness
        return scene if prior is None else prior(scene)

    def framed(self, images: Images) -> tuple[Images, Crops | None]:
        """Images in the crops in which the model expects its object, and the crops if it looks for them."""
        if self.whitening is None or self.whitening.framing is None:
            return images, None
        crops = self.whitening.framing.crops(images)
        return crop_images(images, crops), crops

    def placed(self, scene: Scene, crops: Crops | None) -> Scene:
        """The scenes that whole images show, of scenes found in ``crops`` of them: cameras move back."""
        if crops is None or "camera" not in scene.parameters:
            return scene
        return crop_scene(scene, back(crops), self.settings.ranges.fov_deg)

    def with_brightness(self: Model, prior: BrightnessPrior | None) -> Model:
        """A model that shares these weights, with another prior."""
        model = self.with_features(self.features)
        model.settings = model.settings.model_copy(update={"brightness": prior})
        return model

    @property
    def features(self) -> Features:
        """How features are made of encoder activations."""
        return Features(self.whitening, self.fitting)

    def with_features(self: Model, features: Features) -> Model:
        """A model that shares these weights and makes features in another way."""
        model = copy.copy(self)
        model._modules = dict(self._modules)
        model.whitening, model.fitting = features.whitening, features.fitting
        return model

    def without_features(self: Model) -> Model:
        """A model that shares these weights and whose features are the codes."""
        return self.with_features(Features())

    def embed(self, images: GivenImages) -> dict[str, Rows]:
        """One feature per factor, by name: as ``features`` makes it, else the code.

        Images are (N, 3, S, S) in 0..1, or whatever `as_batch` takes: paths, Pillow images, arrays.
        """
        images = as_batch(images, self.image_size, self.device)
        if self.whitening is None and not self.features.fits_scenes:
            return self.encode(images)
        return self.features_from(self.activations(images, codes=False))

    def activations(
        self, images: Images, codes: bool = True, scenes: Scene | None = None
    ) -> dict[str, Tensor]:
        """Encoder activations (N, D) of images in 0..1, by factor: the code, then the last spatial map.

        Where ``features`` needs them, the mirror image's follow, and the fitted scene's under
        `coordinates_of`. Without ``codes`` factors whose features take another crop or view lack theirs.
        ``scenes``, where they are known, are what ``decode`` makes of the codes: fitting begins there.
        """
        check_images(images, self.image_size)
        framed, _ = self.framed(images)
        known: dict[str, Any] = {"framed": framed, "codes": codes}
        result = {f.name: self.factor_activations(f.name, images, **known) for f in self.factors}
        if self.features.fits_scenes:
            steps = self.features.required_fitting().settings.steps
            fitted = self._fitted(framed, steps, scenes if framed is images else None).coordinates
            result |= {coordinates_of(name): value for name, value in fitted.items()}
        return result

    def factor_activations(
        self, name: str, images: Images, cells: int | None = None,
        framed: Images | None = None, codes: bool = True,
    ) -> Rows:  # fmt: skip
        """``activations`` for one factor, without coordinates.

        Where ``features`` take another crop or the canonical view, its activations follow the code, if
        ``codes``. With ``cells`` `gradient_directions` and `gradient_histograms` of so many along each side
        follow; by default as ``features`` take them. ``framed`` are the images in their crops, if known.
        """
        net, parts = self.nets[name], list[Tensor]()
        framing, shown = self.features.framing(name), images
        if framing is not None:
            shown = framing(images) if framed is None else framed
        shown = self.frontal(shown) if self.features.turns(name) else shown
        code = [net.encoder(images)] if codes and shown is not images else []
        shown = reduced(shown, self.settings.network)
        for one in (shown, shown.flip(-1)) if self.features.mirrors(name) else (shown,):
            parts += [*code, activated := net.activations(one)]
            if cells is None and self.whitening is not None and name in self.whitening.names:
                rest = self.whitening.size(name) - activated.shape[1] - 2 * CELLS**2
                cells = math.isqrt(max(rest, 0) // ORIENTATIONS)
            if cells:
                parts += [gradient_directions(one), gradient_histograms(one, cells)]
        return torch.cat(parts, dim=1)

    def surface(self, images: Images) -> tuple[Float[Tensor, "n h w"], Float[Tensor, "n 6"]]:
        """Depth and camera of images in 0..1, as ``decompose`` finds them in images in its crops."""
        rows, ranges = {row.parameter: row for row in self.factors}, self.settings.ranges
        both = rows["depth"], rows["camera"]
        depth, camera = (row.to_parameter(self.nets[row.name](images), ranges) for row in both)
        return depth, camera

    def canonical_view(self, images: GivenImages) -> Images:
        """The images' own pixels on their surface, seen from the front (`unwarp`); images as for `embed`."""
        return self.frontal(self.framed(as_batch(images, self.image_size, self.device))[0])

    def frontal(self, images: Images) -> Images:
        """The canonical view of images of the model's size; renderings may exceed 1."""
        return unwarp(images, *self.surface(images), self.settings.ranges.fov_deg)

    def codes(self, activations: Mapping[str, Rows]) -> dict[str, Float[Tensor, "n code"]]:
        """The codes that activations begin with: ``encode`` of the same images."""
        names = [factor.name for factor in self.factors if factor.name in activations]
        return {name: activations[name][:, : self.nets[name].code_size] for name in names}

    def features_from(self, activations: Mapping[str, Rows]) -> dict[str, Rows]:
        """``embed`` of the images that these activations belong to; codes alone are a ValueError."""
        return self.features(self.codes(activations), activations)

    def fit_scenes(self, images: GivenImages, steps: int = STEPS) -> Fitted:
        """Scenes optimised per image, from ``decompose`` on and in its crops, downhill through the renderer.

        Some five times as slow as ``decompose``, with a smaller error. On a CPU a scene depends neither on
        other images nor on threads. Without a fitting (``derender whiten`` makes one): a ValueError.
        """
        framed, crops = self.framed(as_batch(images, self.image_size, self.device))
        fitted = self._fitted(framed, steps)
        return replace(fitted, scene=self.placed(fitted.scene, crops))

    def _fitted(self, images: Images, steps: int, scenes: Scene | None = None) -> Fitted:
        fitting, nets = self.features.required_fitting(), self.nets
        rows = [row for row in self.factors if not (row.mirrored or row.parameter in ("light", "camera"))]
        ranged = [lambda raw, own=row: own.to_parameter(raw, self.settings.ranges) for row in rows]
        with torch.no_grad():
            typical = self.decode(self.encode(torch.full_like(images[:1], 0.5)))

        def fitted(places: Tensor) -> Fitted:
            portion, raws = images[places].contiguous(), list[Tensor]()
            few = len(portion) if portion.is_cuda else FEW
            if scenes is None or rows:
                with torch.no_grad():
                    codes = [self.encode(part) for part in portion.split(few)]
                    scene = Scene.joined([self.decode(one) for one in codes])
                    raws = [torch.cat([nets[r.name].decoder(one[r.name]) for one in codes]) for r in rows]
            else:
                scene = scenes[places]
            further = list(zip([row.parameter for row in rows], raws, ranged, strict=True))
            return fitting.fit(portion, scene, self.render, steps, further, typical)

        result = Fitted.joined(_by_portions(fitted, images), len(images))
        return replace(result, scene=self.balanced(result.scene))


def gradient_directions(images: Images) -> Float[Tensor, "n directions"]:
    """Unit vectors (right, down) of the gradient of the mean of colours, averaged over 32x32 cells.

    Slow changes of light turn them little (Gradientfaces, Zhang et al., TIP 2009). Images are in 0..1, at
    least 32 pixels wide and high. Values lie within -0.2..0.2.
    """
    taps = torch.exp(-torch.arange(-3.0, 4.0).square() / (2 * BLUR_PX**2))
    blur = constant(tuple((taps / taps.sum()).tolist()), images)
    grey = pad(images.mean(dim=1, keepdim=True), (4, 4, 4, 4), mode="replicate")
    smooth = conv2d(conv2d(grey, blur.view(1, 1, 1, -1)), blur.view(1, 1, -1, 1))
    right = smooth[..., 1:-1, 2:] - smooth[..., 1:-1, :-2]
    down = smooth[..., 2:, 1:-1] - smooth[..., :-2, 1:-1]
    slope = torch.cat([right, down], dim=1) / 2
    unit = slope / (slope.square().sum(dim=1, keepdim=True).add(1e-10).sqrt() + _DARK)
    return SCALE * adaptive_avg_pool2d(unit, CELLS).flatten(1)


def gradient_histograms(images: Images, side: int = HISTOGRAM_CELLS) -> Float[Tensor, "n histograms"]:
    """Histograms of 12 orientations of the gradient of the mean of colours, in ``side`` x ``side`` cells.

    Each is divided by the root mean square of its 3x3 neighbours, also where it is dark (after Dalal and
    Triggs, CVPR 2005). Images are in 0..1, no narrower or lower than ``side``. Values lie within 0..0.4.
    """
    grey = pad(images.mean(dim=1, keepdim=True), (1, 1, 1, 1), mode="replicate")
    right = grey[..., 1:-1, 2:] - grey[..., 1:-1, :-2]
    down = grey[..., 2:, 1:-1] - grey[..., :-2, 1:-1]
    length = (right.square() + down.square() + 1e-10).sqrt()
    turns = [math.pi * place / ORIENTATIONS for place in range(ORIENTATIONS)]
    cosine, sine = (constant(tuple(map(one, turns)), images).view(-1, 1, 1) for one in (math.cos, math.sin))
    along = (right * cosine + down * sine) / length
    for _ in range(6):  # to the power of 64, which falls to half between two orientations
        along = along.square()
    cells = adaptive_avg_pool2d(length * along, side)
    near = avg_pool2d(pad(cells.square().sum(dim=1, keepdim=True), (1, 1, 1, 1), mode="replicate"), 3, 1)
    return (cells / (near + 1e-10).sqrt()).clamp(max=0.4).flatten(1)


def _by_portions(function: Callable[[Tensor], Fitted], images: Images) -> list[Fitted]:
    """Results for the places of portions of images in order, the last one filled up to fours with the last.

    The function is called by as many threads as torch has, each with one of torch's; on a GPU once, with all.
    """
    count, threads = len(images), torch.get_num_threads()
    if images.is_cuda:
        return [function(torch.arange(count, device=images.device))]
    filled = torch.arange(count + -count % FEW).clamp(max=count - 1)
    portions = filled.split(min(FEW * math.ceil(count / FEW / threads), MOST))
    try:
        with ThreadPoolExecutor(threads, initializer=torch.set_num_threads, initargs=(1,)) as pool:
            return list(pool.map(function, portions))
    finally:
        torch.set_num_threads(threads)  # of threads that are yet to come
