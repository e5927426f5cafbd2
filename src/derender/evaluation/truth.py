"""Are predicted geometry, albedo, light and camera the true ones, up to what no image determines?

Source of SIDE and MAD: Wu, Rupprecht, Vedaldi, CVPR 2020, Sec. 4.1. Both compare depth in the view of the
input image where predicted and true mask overlap. SIDE is the standard deviation of log predicted minus log
true depth, so a global scale costs nothing. MAD is the mean angle between normals. The overlap is eroded by
one pixel, since rasterisers differ at the rim: pixels stay whose four neighbours are inside.

An image fixes albedo only up to a factor that the light compensates. It fixes the canonical frame only up to
one rotation for the whole model. So albedo is compared after the best scale, per image and for the whole set.
Light, in the frame of the camera, is compared as it is and after the best rotation for the set. Camera
rotation is compared after the best one. Leaves out translations: at 10 degrees of field of view they trade
against depth.
"""

from dataclasses import dataclass
from functools import partial
from typing import Any, ClassVar

import numpy as np
import torch
from jaxtyping import Bool, Float
from scipy.ndimage import binary_erosion, generate_binary_structure
from scipy.spatial.transform import Rotation
from torch import Tensor
from torch.nn.functional import normalize

from derender.data import GroundTruth
from derender.evaluation.image_scores import ImageResult, means_and_each
from derender.evaluation.score_table import Column
from derender.features import Progress, map_batches
from derender.features.extract import check_size
from derender.scene.camera import rotation_matrix
from derender.scene.light import light_direction
from derender.scene.normals import normals_from_depth


@dataclass(frozen=True)
class GeometryScores:
    """Errors of predicted depth; means over the images that have at least one pixel to compare.

    ``side`` is scale-invariant, 0 and up, best 0; papers print it times 100. ``mad_deg`` is the mean angle
    between normals, 0..180, best 0. Errors count only where the prediction covers the eroded true mask:
    ``coverage`` is that share, 0..1, best 1. ``n_empty`` images share no pixel with the truth and are left
    out; (N,) values per image are NaN there.
    """

    side: float
    mad_deg: float
    coverage: float
    n_empty: int
    side_each: np.ndarray
    mad_deg_each: np.ndarray


@dataclass(frozen=True)
class GeometryResult(ImageResult):
    """Errors of the predicted depth beside those of controls, all on the same images. Controls are the mean
    true depth map, constant depth, and fresh weights (None without an architecture)."""

    columns: ClassVar = {
        "side": Column("SIDE x 100", "low", note="scale-invariant depth error times 100, best 0", scale=100),
        "mad_deg": Column("MAD", "low", 1, "mean angle between normals in degrees, best 0"),
    }
    caption = "Geometry on {} with exact depth"
    coverage = Column(
        "coverage", None, note="share of the true object that the prediction covers; errors count only there"
    )
    notes: ClassVar = {
        "average depth": "the mean true depth map, the same for every image",
        "untrained model": "same networks, fresh weights",
    }

    model: GeometryScores
    average_depth: GeometryScores
    plane: GeometryScores
    untrained: GeometryScores | None = None


def angle_deg(a: Float[Tensor, "*n 3"], b: Float[Tensor, "*n 3"]) -> Float[Tensor, "*n"]:
    """Angle between vectors in degrees, exact also where it is small (arc cosine is not)."""
    return torch.rad2deg(torch.atan2(torch.linalg.cross(a, b).norm(dim=-1), (a * b).sum(dim=-1)))


def geometry_scores(
    depth_pred: Float[Tensor, "n h w"], mask_pred: Bool[Tensor, "n h w"], depth_true: Float[Tensor, "n h w"],
    mask_true: Bool[Tensor, "n h w"], fov_deg: float, normal_true: Float[Tensor, "n h w 3"] | None = None,
) -> GeometryScores:  # fmt: skip
    """SIDE and MAD of depth maps in the view of the image.

    ``depth_pred`` is metric or up to scale, and does not matter where ``mask_pred`` is not; ``depth_true`` is
    positive inside the object. ``fov_deg`` is horizontal; ``normal_true`` are true normals where they are
    known better than from depth: camera frame, inward.
    """
    cross = generate_binary_structure(2, 1)[None]  # a pixel stays if its four neighbours are inside
    eroded = (binary_erosion(mask.cpu(), cross) for mask in (mask_true, mask_true & mask_pred))
    inside, valid = (torch.from_numpy(mask).to(mask_true.device) for mask in eroded)
    if not inside.any():
        raise ValueError("the true masks are empty after taking one pixel off: nothing to compare")
    if not valid.any():
        raise ValueError("prediction and truth share no pixel in any image: check camera and masks")
    for name, depth in (("predicted", depth_pred), ("true", depth_true)):
        if not bool((torch.isfinite(depth[valid]) & (depth[valid] > 0)).all()):
            raise ValueError(f"{name} depth must be positive and finite inside its mask")

    def mean(values: Tensor) -> Tensor:
        return torch.where(valid, values, torch.nan).nanmean(dim=(1, 2))

    predicted, true = depth_pred.double(), depth_true.double()
    difference = predicted.log() - true.log()
    side = mean((difference - mean(difference)[:, None, None]).square()).sqrt()
    normal = normals_from_depth(true, fov_deg) if normal_true is None else normal_true.double()
    mad = mean(angle_deg(normals_from_depth(predicted, fov_deg), normal))
    coverage, n_empty = (valid.sum() / inside.sum()).item(), int(side.isnan().sum())
    return GeometryScores(coverage=coverage, n_empty=n_empty, **means_and_each(side=side, mad_deg=mad))


def average_depth(depth: Float[Tensor, "n h w"], mask: Bool[Tensor, "n h w"]) -> Float[Tensor, "h w"]:
    """Mean depth of every pixel over the images whose object covers it; the farthest mean where none."""
    mean = torch.where(mask, depth.double(), torch.nan).nanmean(dim=0)
    return mean.nan_to_num(mean[mask.any(dim=0)].max().item()).to(depth.dtype)


def predicted_depth(
    model: Any, images: np.ndarray, *, batch_size: int = 64, progress: Progress | None = None
) -> tuple[Float[Tensor, "n h w"], Bool[Tensor, "n h w"]]:
    """Depth and mask that a model predicts for uint8 images (N, 3, H, W), in each image's own view."""

    def see(batch: Tensor) -> tuple[Tensor, Tensor]:
        rendering = model.render(model.decompose(batch))
        return rendering.depth.cpu(), rendering.mask.cpu() > 0.5

    parts = map_batches(see, model, images, batch_size=batch_size, progress=progress)
    depth, mask = map(torch.cat, zip(*parts, strict=True))
    return depth, mask


def evaluate_geometry(
    model: Any, truth: GroundTruth, *, batch_size: int = 64, untrained: Any = None,
    progress: Progress | None = None,
) -> GeometryResult:  # fmt: skip
    """A model's geometry on images with ground truth, beside average depth, plane and an untrained model.

    ``model`` has ``decompose``, ``render``, ``fov_deg``, ``image_size`` and ``device``; ``truth`` is at its
    image size. ``progress`` is called with (images done, images in all) after every batch.
    """
    check_size(model, truth.images, rendered=True)
    depth, mask = torch.as_tensor(truth.depth), torch.as_tensor(truth.mask) > 0
    normal = None if truth.normal is None else normalize(torch.as_tensor(truth.normal), dim=-1)
    known = {"depth_true": depth, "mask_true": mask, "fov_deg": model.fov_deg, "normal_true": normal}
    score = partial(geometry_scores, **known)
    see = partial(predicted_depth, images=truth.images, batch_size=batch_size)
    everywhere = torch.ones_like(mask)
    return GeometryResult(
        score(*see(model, progress=progress)),
        score(average_depth(depth, mask).expand_as(depth), everywhere),
        score(torch.ones_like(depth), everywhere),
        None if untrained is None else score(*see(untrained)),
    )


@dataclass(frozen=True)
class AngleScores:
    """Angles between predictions and truth in degrees, 0..180, best 0: over images, and (N,) of each."""

    mean_deg: float
    median_deg: float
    each_deg: np.ndarray


@dataclass(frozen=True)
class FactorScores:
    """Errors of albedo, light and camera, best 0: means over images, and (N,) values of each.

    ``albedo`` is ``albedo_error`` in the view of the image, ``albedo_global`` that after one scale for all
    images: confusing bright skin under weak light with dark skin under strong light costs. ``light``,
    ``aligned`` (after the best rotation of all predictions at once) and ``camera`` are degrees, 0..180.
    """

    albedo: float
    albedo_global: float
    light: float
    aligned: float
    camera: float
    albedo_each: np.ndarray
    albedo_global_each: np.ndarray
    light_each: np.ndarray
    aligned_each: np.ndarray
    camera_each: np.ndarray


@dataclass(frozen=True)
class FactorResult(ImageResult):
    """Errors in albedo, light and camera beside the best constant answer, and fresh weights if requested."""

    columns: ClassVar = {
        "albedo": Column("albedo", "low", 4, "root mean square error after each image's best scale, best 0"),
        "albedo_global": Column("one scale", "low", 4, "the same after one scale for all images"),
        "light": Column("light", "low", 1, "mean degrees between true and predicted direction, best 0"),
        "aligned": Column("aligned", "low", 1, "the same after the best rotation of all directions"),
        "camera": Column("camera", "low", 1, "mean angle in degrees of the remaining rotation, best 0"),
    }
    caption = "Albedo, light and camera on {}"
    notes: ClassVar = {"constant answer": "mean albedo, mean light, a camera that never turns"}

    model: FactorScores
    constant: FactorScores
    untrained: FactorScores | None = None


def albedo_error(
    albedo_pred: Float[Tensor, "n 3 h w"], albedo_true: Float[Tensor, "n 3 h w"], mask: Bool[Tensor, "n h w"],
    *, one_scale: bool = False,
) -> Float[Tensor, " n"]:  # fmt: skip
    """Root mean square albedo error after the best scale, per image; 0 and up, best 0; NaN in an empty mask.

    One scale for the three channels, so a colour cast costs. The scale is each image's own, and the error at
    most the root mean square of its true albedo. With ``one_scale`` it is the best for all images together.
    """
    inside = mask[:, None].expand_as(albedo_true)
    predicted, true = (torch.where(inside, a.double(), 0.0) for a in (albedo_pred, albedo_true))
    power, match = (p.sum(dim=(1, 2, 3)) for p in (predicted.square(), predicted * true))
    if one_scale:
        power, match = (p.sum().expand(len(p)) for p in (power, match))
    scale = match / torch.where(power > 0, power, 1.0)
    rest = (scale[:, None, None, None] * predicted - true).square().sum(dim=(1, 2, 3))
    return (rest / inside.sum(dim=(1, 2, 3))).sqrt()


def light_error(
    light_pred: Float[Tensor, "n 4"], camera_pred: Float[Tensor, "n 6"], light_true: Float[Tensor, "n 4"],
    camera_true: Float[Tensor, "n 6"], *, aligned: bool = False,
) -> AngleScores:  # fmt: skip
    """Angle between the directions in which light travels, in the camera's frame; 0..180 degrees, best 0.

    With ``aligned``, after the one rotation of all predicted directions that fits the true ones best (least
    squares), which forgives a constant error.
    """
    predicted, true = light_in_camera(light_pred, camera_pred), light_in_camera(light_true, camera_true)
    if aligned:
        u, _, vh = torch.linalg.svd(predicted.mT @ true)
        u[:, 2] *= torch.linalg.det(u @ vh).sign()  # never a reflection
        predicted = predicted @ u @ vh
    return _angles(angle_deg(predicted, true))


def camera_error(camera_pred: Float[Tensor, "n 6"], camera_true: Float[Tensor, "n 6"]) -> AngleScores:
    """Angle of the rotation left between predicted and true cameras after the best alignment; 0..180
    degrees, best 0.

    The alignment is one rotation A of the canonical frame for all images, predicted = true A, by least
    squares. A constant prediction then scores the spread of the true cameras, which is the control to print
    beside it.
    """
    angles = (camera[:, :3].double().numpy(force=True) for camera in (camera_pred, camera_true))
    predicted, true = (Rotation.from_euler("xyz", angles_rad) for angles_rad in angles)
    turned = true.inv() * predicted
    return _angles(torch.from_numpy((turned.mean().inv() * turned).magnitude()).rad2deg())


def evaluate_factors(
    model: Any, truth: GroundTruth, *, batch_size: int = 64, untrained: Any = None
) -> FactorResult:
    """Albedo, light and camera that a model predicts for images with ground truth, beside constant answers.

    ``truth`` has albedo, light, camera and mask at the model's image size; the rest is as of
    ``evaluate_geometry``.
    """
    for name in ("albedo", "light", "camera"):
        if getattr(truth, name) is None:
            raise ValueError(f"this ground truth has no {name}: give a set that stores it")
    check_size(model, truth.images, rendered=True)
    true, true_mask = torch.as_tensor(truth.albedo), torch.as_tensor(truth.mask)
    exact = torch.as_tensor(truth.light), torch.as_tensor(truth.camera)

    def see(net: Any, batch: Tensor) -> tuple[Tensor, ...]:
        """Albedo and mask in the image's view (rendered under plain ambient light), light, camera."""
        scene = net.decompose(batch)
        white = torch.tensor([1.0, 0.0, 0.0, 0.0], device=batch.device).expand_as(scene.light)
        flat = net.render(scene.with_parameters(light=white))
        return flat.image.cpu(), flat.mask.cpu() > 0.5, scene.light.cpu(), scene.camera.cpu()

    def scored(albedo: Tensor, mask: Tensor, *angles: Tensor | np.ndarray) -> FactorScores:
        errors = (albedo_error(albedo, true, mask, one_scale=one_scale) for one_scale in (False, True))
        each = map(torch.as_tensor, (*errors, *angles))
        return FactorScores(**means_and_each(**dict(zip(FactorResult.columns, each, strict=True))))

    def of(net: Any) -> FactorScores:
        parts = map_batches(partial(see, net), net, truth.images, batch_size=batch_size)
        albedo, mask, light, camera = map(torch.cat, zip(*parts, strict=True))
        if not bool((both := mask & true_mask).any()):
            raise ValueError("prediction and truth share no pixel in any image: check camera and masks")
        lights = (light_error(light, camera, *exact, aligned=one).each_deg for one in (False, True))
        return scored(albedo, both, *lights, camera_error(camera, exact[1]).each_deg)

    mean = (true.sum(dim=0) / true_mask.sum(dim=0).clamp_min(1)).expand_as(true)
    direction = light_in_camera(*exact)
    off = angle_deg(direction.mean(dim=0).expand_as(direction), direction)
    still = camera_error(torch.zeros_like(exact[1]), exact[1]).each_deg
    constant = scored(mean, true_mask, off, off, still)
    return FactorResult(of(model), constant, None if untrained is None else of(untrained))


def light_in_camera(light: Float[Tensor, "n 4"], camera: Float[Tensor, "n 6"]) -> Float[Tensor, "n 3"]:
    return (rotation_matrix(camera[:, :3].double()) @ light_direction(light.double())[..., None])[..., 0]


def _angles(degrees: Tensor) -> AngleScores:
    return AngleScores(degrees.mean().item(), degrees.median().item(), degrees.numpy(force=True))
