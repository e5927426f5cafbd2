"""Is the predicted geometry the true geometry? SIDE and MAD, as unsup3d defines them.

Source: Wu, Rupprecht, Vedaldi, CVPR 2020, Sec. 4.1. Both compare depth in the view of the input image where
predicted and true mask overlap. SIDE is the standard deviation of log predicted minus log true depth, so a
global scale costs nothing. MAD is the mean angle between normals. Each image is scored by itself. The overlap
is eroded by one pixel, since rasterisers differ at the rim: pixels stay whose four neighbours are inside.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
import torch
from jaxtyping import Bool, Float
from scipy.ndimage import binary_erosion, generate_binary_structure
from torch import Tensor

from derender.data import GroundTruth
from derender.evaluation.image_scores import ImageResult, means_and_each
from derender.evaluation.score_table import Column
from derender.features import Progress, map_batches
from derender.features.extract import check_size
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

    columns: ClassVar[Mapping[str, Column]] = {
        "side": Column("SIDE x 100", "low", note="scale-invariant depth error times 100, best 0", scale=100),
        "mad_deg": Column("MAD", "low", 1, "mean angle between normals in degrees, best 0"),
    }
    caption = "Geometry on {} with exact depth"
    coverage = Column(
        "coverage", None, note="share of the true object that the prediction covers; errors count only there"
    )
    titles: ClassVar[Mapping[str, str]] = {
        "model": "model", "average_depth": "average depth", "plane": "plane", "untrained": "untrained model",
    }  # fmt: skip
    notes: ClassVar[Mapping[str, str]] = {
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
    depth_pred: Float[Tensor, "n h w"],
    mask_pred: Bool[Tensor, "n h w"],
    depth_true: Float[Tensor, "n h w"],
    mask_true: Bool[Tensor, "n h w"],
    fov_deg: float,
    normal_true: Float[Tensor, "n h w 3"] | None = None,
) -> GeometryScores:
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
        raise ValueError("prediction and truth share no pixel in any image: check the camera or the masks")
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
    model: Any,
    truth: GroundTruth,
    *,
    batch_size: int = 64,
    untrained: Any = None,
    progress: Progress | None = None,
) -> GeometryResult:
    """A model's geometry on images with ground truth, beside average depth, plane and an untrained model.

    ``model`` has ``decompose``, ``render``, ``fov_deg``, ``image_size`` and ``device``; ``truth`` is at its
    image size. ``progress`` is called with (images done, images in all) after every batch.
    """
    check_size(model, truth.images, rendered=True)
    depth, mask = torch.as_tensor(truth.depth), torch.as_tensor(truth.mask) > 0
    normal = None
    if truth.normal is not None:
        normal = torch.nn.functional.normalize(torch.as_tensor(truth.normal), dim=-1)

    def score(predicted: Tensor, covered: Tensor) -> GeometryScores:
        return geometry_scores(predicted, covered, depth, mask, model.fov_deg, normal)

    everywhere, fresh = torch.ones_like(mask), None
    if untrained is not None:
        fresh = score(*predicted_depth(untrained, truth.images, batch_size=batch_size))
    return GeometryResult(
        score(*predicted_depth(model, truth.images, batch_size=batch_size, progress=progress)),
        score(average_depth(depth, mask).expand_as(depth), everywhere),
        score(torch.ones_like(depth), everywhere),
        fresh,
    )
