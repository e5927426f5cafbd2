"""How far predicted albedo, light and camera are from the true ones, up to what no image determines.

An image fixes albedo only up to a factor that the light compensates, and the canonical frame only up to one
rotation for the whole model (which way an average face looks is a convention). So: albedo is compared after
the best scale per image, and after the best one for the whole set; light in the frame of the camera, as it
is and after the best rotation for the whole set; camera rotation after the best rotation for the whole set.
Leaves out translations: at 10 degrees of field of view they trade against depth.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from derender.data import GroundTruth
from derender.evaluation.bootstrap import RESAMPLES, ScoredRow
from derender.evaluation.depth import angle_deg
from derender.evaluation.image_scores import Columns, image_rows, image_table
from derender.evaluation.score_table import Column, ScoreTable
from derender.features import Progress, map_batches
from derender.scene.camera import rotation_matrix
from derender.scene.light import light_direction

FACTORS: Columns = {
    "albedo": (
        Column("albedo", "low", 4, "root mean square error after each image's best scale, best 0"),
        1.0,
    ),
    "albedo_global": (Column("one scale", "low", 4, "the same after one scale for all images"), 1.0),
    "light": (
        Column("light", "low", 1, "mean angle in degrees between true and predicted direction, best 0"),
        1.0,
    ),
    "aligned": (Column("aligned", "low", 1, "the same after the best rotation of all directions"), 1.0),
    "camera": (Column("camera", "low", 1, "mean angle in degrees of the remaining rotation, best 0"), 1.0),
}


@dataclass(frozen=True)
class AngleScores:
    """Angles between predictions and truth.

    Attributes:
        mean_deg: mean over images, 0..180, best 0.
        median_deg: median over images, 0..180, best 0.
        each_deg: (N,) per image.
    """

    mean_deg: float
    median_deg: float
    each_deg: np.ndarray


@dataclass(frozen=True)
class FactorResult:
    """A model's errors in albedo, light and camera, each beside the best constant answer.

    Attributes:
        albedo: mean over images of ``albedo_error``, in the view of the image; 0 and up, best 0.
        albedo_control: the same of the mean true albedo.
        albedo_global, albedo_global_control: the same after one scale for all images, so that a model that
            confuses bright skin under weak light with dark skin under strong light scores worse.
        light, light_control: of the predictions, and of the mean true direction.
        light_aligned: of the predictions after the best rotation of all of them at once; its control is
            ``light_control`` too, since a rotation brings any constant to the mean direction.
        camera, camera_control: of the predictions, and of a camera that never turns.
        albedo_each, albedo_global_each: (N,) of the predictions per image, NaN where prediction and truth
            share no pixel.
        albedo_control_each, albedo_global_control_each: (N,) of the mean true albedo.
    """

    albedo: float
    albedo_control: float
    albedo_global: float
    albedo_global_control: float
    light: AngleScores
    light_control: AngleScores
    light_aligned: AngleScores
    camera: AngleScores
    camera_control: AngleScores
    albedo_each: np.ndarray
    albedo_global_each: np.ndarray
    albedo_control_each: np.ndarray
    albedo_global_control_each: np.ndarray

    def rows(
        self, untrained: "FactorResult | None" = None, resample_count: int = RESAMPLES
    ) -> tuple[ScoredRow, ...]:
        """The model, the best constant answers and an untrained model, with intervals; lower is better."""
        light, albedo = self.light_control, (self.albedo_control_each, self.albedo_global_control_each)
        constant = (*albedo, light.each_deg, light.each_deg, self.camera_control.each_deg)
        named = {"model": self._each, "constant answer": constant}
        named |= {} if untrained is None else {"untrained model": untrained._each}
        each = {name: dict(zip(FACTORS, values, strict=True)) for name, values in named.items()}
        return image_rows(each, FACTORS, resample_count=resample_count)

    def table(
        self, untrained: "FactorResult | None" = None, rows: Sequence[ScoredRow] | None = None
    ) -> ScoreTable:
        """Errors of albedo, light and camera beside the controls; with ``rows``, their intervals too."""
        return image_table(
            f"Albedo, light and camera on {len(self.albedo_each):,} images",
            rows or self.rows(untrained, 1),
            FACTORS,
            intervals=rows is not None,
            notes={"constant answer": "mean albedo, mean light, a camera that never turns"},
        )

    @property
    def _each(self) -> tuple[np.ndarray, ...]:
        angles = (self.light, self.light_aligned, self.camera)
        return (self.albedo_each, self.albedo_global_each, *(angle.each_deg for angle in angles))


def albedo_error(
    albedo_pred: Float[Tensor, "n 3 h w"],
    albedo_true: Float[Tensor, "n 3 h w"],
    mask: Bool[Tensor, "n h w"],
    *,
    one_scale: bool = False,
) -> Float[Tensor, " n"]:
    """Root mean square albedo error after the best scale, per image; 0 and up, best 0.

    One scale for the three channels, so a colour cast costs. The scale is each image's own, and the error
    at most the root mean square of its true albedo; or, with ``one_scale``, the best for all images
    together.
    """
    inside = mask[:, None].expand_as(albedo_true)
    count = inside.sum(dim=(1, 2, 3))
    if bool((count == 0).any()):
        raise ValueError(f"the mask of {int((count == 0).sum())} images is empty: leave these images out")
    predicted, true = (torch.where(inside, a.double(), 0.0) for a in (albedo_pred, albedo_true))
    power, match = (p.sum(dim=(1, 2, 3)) for p in (predicted.square(), predicted * true))
    if one_scale:
        power, match = (p.sum().expand(len(p)) for p in (power, match))
    scale = match / torch.where(power > 0, power, 1.0)
    rest = (scale[:, None, None, None] * predicted - true).square().sum(dim=(1, 2, 3))
    return (rest / count).sqrt()


def light_error(
    light_pred: Float[Tensor, "n 4"],
    camera_pred: Float[Tensor, "n 6"],
    light_true: Float[Tensor, "n 4"],
    camera_true: Float[Tensor, "n 6"],
    *,
    aligned: bool = False,
) -> AngleScores:
    """Angle between the directions in which light travels, in the camera's frame; 0..180 degrees, best 0.

    With ``aligned``, after the one rotation of all predicted directions that fits the true ones best (least
    squares), which forgives a constant error.
    """
    predicted, true = _light_in_camera(light_pred, camera_pred), _light_in_camera(light_true, camera_true)
    return _between(predicted @ _best_rotation(predicted, true) if aligned else predicted, true)


def camera_error(camera_pred: Float[Tensor, "n 6"], camera_true: Float[Tensor, "n 6"]) -> AngleScores:
    """Angle of the rotation left between predicted and true cameras after the best alignment; 0..180
    degrees, best 0.

    The alignment is one rotation A of the canonical frame for all images, predicted = true A, by least
    squares. A constant prediction then scores the spread of the true cameras, which is the control to print
    beside it.
    """
    predicted, true = (rotation_matrix(camera[:, :3].double()) for camera in (camera_pred, camera_true))
    rest = (true @ _nearest_rotation((true.mT @ predicted).sum(dim=0))).mT @ predicted
    twist = rest - rest.mT
    sine = torch.stack([twist[:, 2, 1], twist[:, 0, 2], twist[:, 1, 0]]).norm(dim=0) / 2
    cosine = (rest.diagonal(dim1=1, dim2=2).sum(dim=1) - 1) / 2
    return _angles(torch.rad2deg(torch.atan2(sine, cosine)))


def evaluate_factors(
    model: Any, truth: GroundTruth, *, batch_size: int = 64, progress: Progress | None = None
) -> FactorResult:
    """Albedo, light and camera that a model predicts for images with ground truth, beside constant answers.

    Args:
        model: with ``decompose``, ``render``, ``image_size``, ``device``.
        truth: images with albedo, light, camera and mask at the model's image size.
        batch_size: images at a time; changes speed and memory only.
        progress: called with (images done, images in all) after every batch.
    """
    if truth.albedo is None or truth.light is None or truth.camera is None:
        lacking = next(name for name in ("albedo", "light", "camera") if getattr(truth, name) is None)
        raise ValueError(f"this ground truth has no {lacking}: give a set that stores it")
    size = truth.images.shape[-1]
    if size != model.image_size:
        raise ValueError(f"the ground truth is {size} pixels wide, the model takes {model.image_size}")
    albedo, mask, light, camera = _predictions(model, truth.images, batch_size, progress)
    albedo_true, mask_true = torch.as_tensor(truth.albedo), torch.as_tensor(truth.mask)
    light_true, camera_true = torch.as_tensor(truth.light), torch.as_tensor(truth.camera)
    both = mask & mask_true
    seen = both.any(dim=(1, 2))
    if not bool(seen.any()):
        raise ValueError("prediction and truth share no pixel in any image: check the camera or the masks")
    constant = (albedo_true.sum(dim=0) / mask_true.sum(dim=0).clamp_min(1)).expand_as(albedo_true)
    direction = _light_in_camera(light_true, camera_true)
    own, own_global = torch.full((2, len(albedo)), torch.nan, dtype=torch.float64)
    own[seen] = albedo_error(albedo[seen], albedo_true[seen], both[seen])
    own_global[seen] = albedo_error(albedo[seen], albedo_true[seen], both[seen], one_scale=True)
    fixed = albedo_error(constant, albedo_true, mask_true)
    fixed_global = albedo_error(constant, albedo_true, mask_true, one_scale=True)
    return FactorResult(
        albedo=own.nanmean().item(),
        albedo_control=fixed.mean().item(),
        albedo_global=own_global.nanmean().item(),
        albedo_global_control=fixed_global.mean().item(),
        light=light_error(light, camera, light_true, camera_true),
        light_control=_between(direction.mean(dim=0).expand_as(direction), direction),
        light_aligned=light_error(light, camera, light_true, camera_true, aligned=True),
        camera=camera_error(camera, camera_true),
        camera_control=camera_error(torch.zeros_like(camera_true), camera_true),
        albedo_each=own.numpy(),
        albedo_global_each=own_global.numpy(),
        albedo_control_each=fixed.numpy(),
        albedo_global_control_each=fixed_global.numpy(),
    )


def _predictions(
    model: Any, images: np.ndarray, batch_size: int, progress: Progress | None
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Albedo and mask in the image's view (rendered under plain ambient light), light, camera."""

    def see(batch: Tensor) -> tuple[Tensor, ...]:
        scene = model.decompose(batch)
        white = torch.tensor([1.0, 0.0, 0.0, 0.0], device=batch.device).expand_as(scene.light)
        flat = model.render(scene.with_parameters(light=white))
        return flat.image.cpu(), flat.mask.cpu() > 0.5, scene.light.cpu(), scene.camera.cpu()

    parts = map_batches(see, model, images, batch_size=batch_size, progress=progress)
    albedo, mask, light, camera = (torch.cat(values) for values in zip(*parts, strict=True))
    return albedo, mask, light, camera


def _light_in_camera(light: Float[Tensor, "n 4"], camera: Float[Tensor, "n 6"]) -> Float[Tensor, "n 3"]:
    return (rotation_matrix(camera[:, :3].double()) @ light_direction(light.double())[..., None])[..., 0]


def _best_rotation(a: Float[Tensor, "n 3"], b: Float[Tensor, "n 3"]) -> Float[Tensor, "3 3"]:
    """The rotation Q for which the rows of a @ Q come nearest to those of b (Wahba's problem)."""
    return _nearest_rotation(a.mT @ b)


def _nearest_rotation(matrix: Float[Tensor, "3 3"]) -> Float[Tensor, "3 3"]:
    """The rotation with the largest inner product with a matrix; never a reflection."""
    u, _, vh = torch.linalg.svd(matrix)
    signs = torch.ones(3, dtype=u.dtype, device=u.device)
    signs[2] = torch.linalg.det(u @ vh).sign()
    return (u * signs) @ vh


def _between(a: Float[Tensor, "n 3"], b: Float[Tensor, "n 3"]) -> AngleScores:
    """Angles between directions of any length."""
    return _angles(angle_deg(a, b))


def _angles(degrees: Tensor) -> AngleScores:
    return AngleScores(degrees.mean().item(), degrees.median().item(), degrees.numpy(force=True))
