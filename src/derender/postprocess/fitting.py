"""Test-time optimisation: scenes fitted per image, from the encoders' prediction down through the renderer.

Geometry and albedo move within a morphable model (Blanz and Vetter, SIGGRAPH 1999), other factors freely. Its
examples are the trained model's predictions, each averaged with its mirror image, for the object is
symmetric. The rendering comes near the image; coordinates far from their mean cost more.
"""

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from jaxtyping import Float
from pydantic import Field, ValidationError, model_validator
from torch import Tensor, nn
from torch.nn.functional import pad

from derender.render import Rendering
from derender.scene import Scene
from derender.settings import Settings
from derender.storage.bounded import first_line, parse_json
from derender.storage.tensors import read_described, write_tensors

PARAMETERS = {"geometry": "depth", "albedo": "albedo"}  # fitted within the morphable model: what they fill
STEPS = 20  # twice as many bring the error down by half a percent more

_START_LIMIT = 2.5  # standard deviations; predictions beyond are unreliable
_COORDINATES = (0.1, -math.inf, math.inf)  # how far a step goes, least and most: standard deviations
_LIGHT = [(0.03, 0.02, 1.2)] * 2 + [(0.03, -math.radians(80), math.radians(80))] * 2
"""Ambient, diffuse, radians; images may be brighter than the ranges allow."""
_CAMERA = [(0.01, -math.radians(75), math.radians(75))] * 3 + [(0.003, -0.4, 0.4)] * 3
"""Radians, scene units; beyond, little is left in the image."""
_FURTHER = (0.05, -4.0, 4.0)  # what a network gives before its tanh
_LATE, _LATE_RATE = 0.7, 0.3  # from this share of the steps on rates are multiplied by this
_STEP, _MOMENTUM = 0.3, (0.7, 0.95)  # Adam's, along directions in which a step of 1 changes the loss alike
_DAMPING = 0.02  # of the steepest direction: flatter ones are taken for as steep
_TYPICAL = ((0.4, -0.6, -0.15, 0.35), (-0.4, 0.6, 0.15, -0.35))
"""Pitch and yaw of the light and of the camera (radians) where the steepness of the loss is measured."""
_NEAR = 4.0  # differences that measure it: half a standard deviation, 0.04 radians
NOISE = 0.03  # mean absolute error, 0..1, that counts as much as coordinates, or a distilled gap, of 1
_BLOCK = 16  # rows of a product; with fewer it waits for memory
_BEYOND = 0.1  # what an error beyond the tolerance still counts


def coordinates_of(factor: str) -> str:
    """The key under which activations hold a factor's fitted coordinates."""
    return f"{factor} fitted"


class FittingSettings(Settings):
    """How scenes are fitted to images; 0 examples: they cannot be."""

    examples: int = Field(default=2_000, ge=0)  # training images whose maps the morphable model is made of
    coordinates: int = Field(default=64, ge=1)  # of geometry, and of albedo
    steps: int = Field(default=0, ge=0, le=10_000)  # of every image for its features; 0: feed-forward only
    prior: float = Field(default=0.1, ge=0)  # how much unusual coordinates cost
    tolerance: float = Field(default=0.15, gt=0)  # error of a pixel beyond which it hardly counts more
    weight: float = Field(default=1.0, ge=0)  # length of fitted coordinates beside feed-forward features

    @model_validator(mode="after")
    def _possible(self) -> "FittingSettings":
        if self.steps and self.examples < 2:
            raise ValueError(f"{self.steps} steps need 2 examples or more, got {self.examples}")
        return self


class MorphableMaps(nn.Module):
    """Coordinates to maps and back, by name: a mean, and what a coordinate of 1 of each axis adds to it."""

    def __init__(self, means: Mapping[str, Tensor], axes: Mapping[str, Tensor]):
        super().__init__()
        self.names = tuple(means)
        for name in self.names:
            one, other = tuple(axes[name].shape[1:]), tuple(means[name].shape)
            if one != other:
                raise ValueError(f"{name}: axes of {one} beside a mean of {other}")
            self.register_buffer(f"{name}_mean", means[name].float(), persistent=False)
            self.register_buffer(f"{name}_axes", axes[name].float(), persistent=False)

    @classmethod
    def of(cls, examples: Mapping[str, Float[Tensor, "n ..."]], coordinates: int) -> "MorphableMaps":
        """The directions in which maps vary most, by name, at most as many as differ; same maps, same model.

        What the mirror images (along the last axis) share with them counts. Fewer than two are a ValueError.
        """
        means, axes = {}, {}
        for name, maps in examples.items():
            if len(maps) < 2:
                raise ValueError(f"a morphable model needs 2 examples or more, got {len(maps)}")
            both = ((maps + maps.flip(-1)) / 2).flatten(1).float()
            mean = both.mean(dim=0)
            deviations, directions = _principal(both - mean, min(coordinates, len(maps) - 1))
            means[name] = mean.reshape(maps.shape[1:])
            axes[name] = (directions * deviations[:, None]).reshape(-1, *maps.shape[1:])
        return cls(means, axes)

    def size(self, name: str) -> int:
        """How many coordinates a name has."""
        return len(self.get_buffer(f"{name}_axes"))

    def maps(self, name: str, coordinates: Float[Tensor, "n k"]) -> Float[Tensor, "n ..."]:
        """The maps that coordinates stand for."""
        mean, axes = self.get_buffer(f"{name}_mean"), self.get_buffer(f"{name}_axes")
        return mean + in_blocks(coordinates, axes.flatten(1)).unflatten(1, mean.shape)

    def coordinates(self, name: str, maps: Float[Tensor, "n ..."]) -> Float[Tensor, "n k"]:
        """Of the nearest map the model has; an axis without length has coordinate 0."""
        mean, axes = self.get_buffer(f"{name}_mean"), self.get_buffer(f"{name}_axes").flatten(1)
        squared = axes.square().sum(dim=1)
        result = in_blocks((maps - mean).flatten(1), axes.T)
        return torch.where(squared > 0, result / squared.clamp(min=torch.finfo(squared.dtype).tiny), 0.0)


def _principal(centred: Float[Tensor, "n d"], count: int) -> tuple[Float[Tensor, " k"], Float[Tensor, "k d"]]:
    """The largest principal components: standard deviations and directions, by the smaller Gram matrix."""
    from scipy.linalg import eigh  # only the largest: torch would find all

    rows, columns = centred.shape
    count = min(count, rows, columns)
    wide = columns > rows
    exact = centred.double()  # float32 sums depend on where memory begins
    gram = (exact @ exact.T if wide else exact.T @ exact).cpu().numpy()
    result = eigh(gram, subset_by_index=[len(gram) - count, len(gram) - 1])
    variances, vectors = (torch.tensor(part).flip(-1).to(exact) for part in result)
    directions = vectors.T @ exact if wide else vectors.T
    length = directions.norm(dim=1, keepdim=True)
    distinct = (variances > variances.max() * 1e-10)[:, None]
    directions = directions / length.clamp(min=torch.finfo(exact.dtype).tiny) * distinct
    return (variances.clamp(min=0) / rows).sqrt().to(centred), directions.to(centred)


def in_blocks(rows: Float[Tensor, "n k"], matrix: Float[Tensor, "k m"]) -> Float[Tensor, "n m"]:
    """Products of 16 rows at a time, with zeros below: rounding depends on their number, steps magnify it."""
    if rows.is_cuda:
        return rows @ matrix
    filled = pad(rows, (0, 0, 0, -len(rows) % _BLOCK))
    return torch.cat([part @ matrix for part in filled.split(_BLOCK)])[: len(rows)]


@dataclass(frozen=True)
class Fitted:
    """Scenes fitted to images, and by factor their coordinates, in the training maps' standard deviations.

    ``before``, ``after``: (N,) mean absolute errors where the surface is seen, limited softly at each pixel.
    """

    scene: Scene
    coordinates: dict[str, Float[Tensor, "n k"]]
    before: Float[Tensor, " n"]
    after: Float[Tensor, " n"]

    @classmethod
    def joined(cls, parts: Sequence["Fitted"], count: int) -> "Fitted":
        """The first so many of all parts, one after the other."""

        def join(values: Iterable[Tensor]) -> Tensor:
            return torch.cat(list(values))[:count]

        coordinates = {name: join(one.coordinates[name] for one in parts) for name in parts[0].coordinates}
        errors = (join(one.before for one in parts), join(one.after for one in parts))
        return cls(Scene.joined([one.scene for one in parts])[:count], coordinates, *errors)


class Fitting(nn.Module):
    """Fits scenes to images by ``maps`` of depth and albedo; a coordinate times ``length`` is a feature's."""

    def __init__(self, maps: MorphableMaps, settings: FittingSettings, length: float = 1.0):
        super().__init__()
        self.maps, self.settings = maps, settings
        self.register_buffer("length", torch.tensor(float(length)), persistent=False)
        numbers = [settings.steps, settings.prior, settings.tolerance]
        numbers += [_STEP] if settings.steps else []  # features of plain Adam are others
        numbers = torch.tensor(numbers, dtype=torch.float64)
        self.register_buffer("told", numbers, persistent=False)  # the name is part of a model's fingerprint
        self._directions: Tensor | None = None

    def with_steps(self, steps: int) -> "Fitting":
        """The same, with the same maps, that makes so many steps; 0: features are feed-forward only."""
        settings = FittingSettings.model_validate(self.settings.model_dump() | {"steps": steps})
        length = self.get_buffer("length")
        return Fitting(self.maps, settings, float(length)).to(length.device)

    def features(self, coordinates: Float[Tensor, "n k"]) -> Float[Tensor, "n k"]:
        """Coordinates in the unit of the feed-forward features beside them."""
        return coordinates * self.get_buffer("length")

    @torch.inference_mode(False)
    @torch.enable_grad()
    def fit(
        self, images: Float[Tensor, "n 3 h w"], scene: Scene, render: Callable[[Scene], Rendering],
        steps: int | None = None, further: Sequence[tuple[str, Tensor, Callable[[Tensor], Tensor]]] = (),
        typical: Scene | None = None,
    ) -> Fitted:  # fmt: skip
        """Fit scenes to images in 0..1, each by itself.

        ``further`` are parameters, raw outputs, ranges. ``typical`` has one scene, whose parameters that are
        not fitted stand where the steepness of the loss is measured (by default the first scene's).
        """
        steps = self.settings.steps if steps is None else steps
        if steps < 1:
            raise ValueError(f"fitting needs 1 step or more, got {steps}")
        images, scene = images.detach().clone(), scene.map(lambda value: value.detach().clone())
        known = [(name, scene.parameters[name].float()) for name in PARAMETERS.values()]
        coordinates = [self.maps.coordinates(*one).clamp(-_START_LIMIT, _START_LIMIT) for one in known]
        loose = [raw.float().clamp(-0.99, 0.99).atanh() for _, raw, _ in further]
        start = [*coordinates, *loose, scene.light.float(), scene.camera.float()]
        sizes = [value.shape[1] for value in start]
        table = [_COORDINATES] * sum(sizes[:2]) + [_FURTHER] * sum(sizes[2:-2]) + _LIGHT + _CAMERA
        rates, low, high = images.new_tensor(table).T.contiguous()

        def rendered(moved: Tensor, extra: Mapping[str, Tensor]) -> tuple[Scene, Rendering, list[Tensor]]:
            """Scenes of parameters in ``rates``, their renderings, and their coordinates."""
            *result, light, camera = (moved * rates).split(sizes, dim=1)
            result, raws = result[:2], result[2:]
            depth, albedo = map(self.maps.maps, PARAMETERS.values(), result)
            own = {name: ranged(raw.tanh()) for (name, _, ranged), raw in zip(further, raws, strict=True)}
            values = {"depth": depth, "albedo": albedo.clamp(0, 1), "camera": camera, **extra, **own}
            present = Scene.from_parameters(values if "environment" in values else values | {"light": light})
            return present, render(present), result

        def error_of(rendering: Rendering) -> Tensor:
            apart = (rendering.image - images).abs().mean(dim=1)
            beyond = (apart - self.settings.tolerance).clamp(min=0)
            limited, covered = (apart - (1 - _BEYOND) * beyond).flatten(1), rendering.mask.flatten(1)
            return (limited * covered).sum(dim=1) / covered.sum(dim=1).clamp(min=1)

        directions = self._directions
        if directions is None or directions.shape[0] != len(rates) or directions.device != images.device:
            one = (typical or scene)[:1]

            def alone(moved: Tensor) -> Rendering:
                same = one.map(lambda value: value.expand(len(moved), *value.shape[1:]))
                return rendered(moved, same.extra)[1]

            self._directions = directions = self._measured_directions(alone, rates, sizes)
        moved = torch.cat(start, dim=1) / rates
        mean, square = torch.zeros_like(moved), torch.zeros_like(moved)
        before = torch.empty(0)
        for step in range(steps):
            rate, count = _LATE_RATE if step >= _LATE * steps else 1.0, moved.new_tensor(step + 1.0)
            _, rendering, result = rendered(moved.requires_grad_(), scene.extra)
            error = error_of(rendering)
            before = error.detach() if step == 0 else before
            usual = torch.stack([value.square().mean(dim=1) for value in result]).sum(dim=0)
            loss = (error / NOISE + self.settings.prior * usual).sum()
            (gradient,) = torch.autograd.grad(loss, moved)
            with torch.no_grad():
                # what is at its bound and pulled outwards stays, and moves nothing with it
                held = ((moved <= low / rates) & (gradient > 0)) | ((moved >= high / rates) & (gradient < 0))
                gradient, along = gradient.masked_fill(held, 0.0), torch.zeros_like(moved)
                torch.ops.aten._fused_adam_(  # torch.optim first imports the compiler, for a second
                    [along], [in_blocks(gradient, directions)], [mean], [square], [], [count],
                    lr=rate * _STEP, beta1=_MOMENTUM[0], beta2=_MOMENTUM[1], eps=1e-8, weight_decay=0.0,
                    amsgrad=False, maximize=False,
                )  # fmt: skip
                step_to = in_blocks(along, directions.T).masked_fill(held, 0.0)
                moved = (moved.detach() + step_to).clamp(low / rates, high / rates)
        with torch.no_grad():
            fitted, rendering, result = rendered(moved, scene.extra)
        after = error_of(rendering)
        return Fitted(fitted.detach(), dict(zip(PARAMETERS, result, strict=True)), before, after)

    @torch.no_grad()
    def _measured_directions(
        self, render: Callable[[Tensor], Rendering], rates: Float[Tensor, " p"], sizes: Sequence[int]
    ) -> Float[Tensor, "p p"]:
        """Directions, as columns, in which a step of 1 changes the loss of typical scenes alike.

        Inverse of the Cholesky factor of the Hessian after Gauss and Newton, by differences of renderings.
        """
        usual = rates.new_tensor([2 * self.settings.prior / size for size in sizes[:2] for _ in range(size)])
        hessian = torch.zeros(len(rates), len(rates)).to(rates).double()
        hessian.diagonal()[: len(usual)] += usual * rates[: len(usual)].square()
        near = _NEAR * torch.eye(len(rates)).to(rates)
        for angles in _TYPICAL:
            light_camera = rates.new_tensor([0.5, 0.5, *angles, 0, 0, 0, 0])
            at = torch.cat([torch.zeros_like(rates[:-10]), light_camera]) / rates
            shown = [render(part) for part in torch.cat([at + near, at - near]).split(32)]
            above, below = torch.cat([part.image for part in shown]).flatten(1).double().chunk(2)
            change, covered = (above - below) / (2 * _NEAR), shown[0].mask[0].sum().clamp(min=1)
            hessian += change @ change.T / (3 * covered * NOISE**2 * len(_TYPICAL))
        hessian.diagonal().add_(_DAMPING * torch.linalg.matrix_norm(hessian, 2).clamp(min=1e-6))
        factor = torch.linalg.cholesky(hessian)
        unit = torch.eye(len(rates)).to(hessian)
        return torch.linalg.solve_triangular(factor, unit, upper=False).T.float().contiguous()

    def save(self, file: Path) -> None:
        """Write it; complete or not at all."""
        write_tensors(dict(self.named_buffers()), file, {"settings": self.settings.model_dump_json()})

    @classmethod
    @torch.inference_mode(False)  # its maps take part in gradients
    def load(cls, file: Path, image_size: int | None = None) -> "Fitting":
        """Read what ``save`` wrote; damage, or maps of another side than ``image_size``, is a ValueError."""
        tensors, metadata = read_described(file)
        try:
            settings = parse_json(metadata["settings"], FittingSettings)
            means = {name: tensors[f"maps.{name}_mean"] for name in PARAMETERS.values()}
            axes = {name: tensors[f"maps.{name}_axes"] for name in PARAMETERS.values()}
            fitting = cls(MorphableMaps(means, axes), settings, float(tensors["length"]))
        except (KeyError, ValidationError, RuntimeError) as error:
            raise ValueError(f"{Path(file).name} holds no fitting ({first_line(error)})") from error
        for name, mean in means.items():
            expected = (*mean.shape[:-2], image_size, image_size)
            if image_size is not None and tuple(mean.shape) != expected:
                raise ValueError(f"it fits {name} of {tuple(mean.shape)}, the model's is {expected}")
        return fitting
