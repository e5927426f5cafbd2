"""Is the predicted geometry the true geometry? SIDE and MAD, as unsup3d defines them.

Source: Wu, Rupprecht, Vedaldi, CVPR 2020, Sec. 4.1. Both compare depth in the view of the input image,
where predicted and true mask overlap, eroded by one pixel (the rim is where rasterisers differ). SIDE is
the standard deviation of log predicted minus log true depth, so a global scale costs nothing; MAD is the
mean angle between normals. Each image is scored by itself and the images are averaged.

The erosion takes away a pixel when one of its four neighbours is outside, beyond the border counting as
outside: what stays are exactly the pixels whose central differences lie inside the mask. On synface64's
test_gt with the stored normals the average depth then scores SIDE 1.51e-2 and MAD 22.4 degrees, a plane
2.28e-2 and 38.9. Eroding with all eight neighbours, as a 3x3 pooling does, gives 1.48e-2, 22.4 and 2.25e-2,
38.7. Normals taken from true depth instead of the stored ones raise MAD to 22.9 and 40.0.
Leaves out errors of light, camera and albedo (evaluation/factors.py).
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
from derender.evaluation.image_scores import Columns, image_rows, image_table
from derender.evaluation.score_table import Column, ScoreTable
from derender.features import Progress, map_batches
from derender.scene.normals import normals_from_depth

GEOMETRY: Columns = {
    "side": (Column("SIDE x 100", "low", note="scale-invariant depth error times 100, best 0"), 100.0),
    "mad_deg": (Column("MAD", "low", 1, "mean angle between normals in degrees, best 0"), 1.0),
}
COVERAGE = Column(
    "coverage", None, note="share of the true object that the prediction covers; errors count only there"
)


@dataclass(frozen=True)
class GeometryScores:
    """Errors of predicted depth; means over the images that have at least one pixel to compare.

    Attributes:
        side: scale-invariant depth error, 0 and up, best 0. Papers print it times 100.
        mad_deg: mean angle between normals in degrees, 0..180, best 0.
        coverage: share of the eroded true mask that the prediction covers, 0..1, best 1: errors are measured
            only there, so a prediction without the hard part must be visible.
        n_empty: images where prediction and truth share no pixel; left out of the two means.
        side_each, mad_deg_each: (N,) per image, NaN where there is nothing to compare.
    """

    side: float
    mad_deg: float
    coverage: float
    n_empty: int
    side_each: np.ndarray
    mad_deg_each: np.ndarray


@dataclass(frozen=True)
class GeometryResult:
    """A model's errors beside its controls, all on the same images.

    Attributes:
        model: of the predicted depth.
        average_depth: of the mean true depth map, the same for every image.
        plane: of constant depth.
        untrained: of the same architecture with fresh weights; None without one.
    """

    model: GeometryScores
    average_depth: GeometryScores
    plane: GeometryScores
    untrained: GeometryScores | None = None

    def _named(self) -> dict[str, GeometryScores]:
        named = {"model": self.model, "average depth": self.average_depth, "plane": self.plane}
        return named if self.untrained is None else {**named, "untrained model": self.untrained}

    def rows(self, resample_count: int = RESAMPLES) -> tuple[ScoredRow, ...]:
        """The model, then its controls, ``side`` and ``mad_deg`` with intervals; lower is better."""
        each = {name: {"side": s.side_each, "mad_deg": s.mad_deg_each} for name, s in self._named().items()}
        return image_rows(each, GEOMETRY, resample_count=resample_count)

    def table(self, rows: Sequence[ScoredRow] | None = None) -> ScoreTable:
        """Depth and normal errors beside the controls; with ``rows``, their intervals too."""
        return image_table(
            f"Geometry on {len(self.model.side_each):,} images with exact depth",
            rows or self.rows(1),
            GEOMETRY,
            intervals=rows is not None,
            more={COVERAGE: {name: scores.coverage for name, scores in self._named().items()}},
            notes={
                "average depth": "the mean true depth map, the same for every image",
                "untrained model": "same networks, fresh weights",
            },
        )


def erode(mask: Bool[Tensor, "n h w"]) -> Bool[Tensor, "n h w"]:
    """Take one pixel off: what stays is inside with its four neighbours; beyond the border is outside."""
    padded = torch.nn.functional.pad(mask, (1, 1, 1, 1), value=False)
    inner = padded[:, 1:-1, :-2] & padded[:, 1:-1, 2:] & padded[:, :-2, 1:-1] & padded[:, 2:, 1:-1]
    return mask & inner


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

    Args:
        depth_pred: metric or up to scale; values outside ``mask_pred`` do not matter.
        mask_pred: where there is a prediction.
        depth_true: true depth, positive inside ``mask_true``.
        mask_true: the object.
        fov_deg: horizontal field of view of the images.
        normal_true: true normals where they are known better than from depth (rendered ones); camera frame,
            inward.
    """
    inside = erode(mask_true)
    valid = erode(mask_true & mask_pred)
    if not inside.any():
        raise ValueError("the true masks are empty after taking one pixel off: nothing to compare")
    for name, depth in (("predicted", depth_pred), ("true", depth_true)):
        if not bool((torch.isfinite(depth[valid]) & (depth[valid] > 0)).all()):
            raise ValueError(f"{name} depth must be positive and finite inside its mask")
    depth_pred, depth_true = depth_pred.double(), depth_true.double()
    pixels = valid.sum(dim=(1, 2))
    difference = _where(valid, _log(depth_pred, valid) - _log(depth_true, valid))
    centred = _where(valid, difference - (difference.sum(dim=(1, 2)) / pixels)[:, None, None])
    side = (centred.square().sum(dim=(1, 2)) / pixels).sqrt()
    normal_pred = normals_from_depth(_filled(depth_pred, mask_pred), fov_deg)
    if normal_true is None:
        normal_true = normals_from_depth(_filled(depth_true, mask_true), fov_deg)
    mad = _where(valid, angle_deg(normal_pred, normal_true.double())).sum(dim=(1, 2)) / pixels
    empty = pixels == 0
    if bool(empty.all()):
        raise ValueError("prediction and truth share no pixel in any image: check the camera or the masks")
    return GeometryScores(
        side=side[~empty].mean().item(),
        mad_deg=mad[~empty].mean().item(),
        coverage=(valid.sum() / inside.sum()).item(),
        n_empty=int(empty.sum()),
        side_each=side.numpy(force=True),
        mad_deg_each=mad.numpy(force=True),
    )


def average_depth(depth: Float[Tensor, "n h w"], mask: Bool[Tensor, "n h w"]) -> Float[Tensor, "h w"]:
    """Mean depth of every pixel over the images whose object covers it; the farthest mean where none."""
    count = mask.sum(dim=0)
    mean = _where(mask, depth.double()).sum(dim=0) / count
    return torch.where(count > 0, mean, mean[count > 0].max()).to(depth.dtype)


def geometry_controls(truth: GroundTruth, fov_deg: float) -> tuple[GeometryScores, GeometryScores]:
    """Scores of the average depth map over these images and of a plane at depth 1."""
    depth, mask, normal = _truth(truth)
    everywhere = torch.ones_like(mask)
    average = average_depth(depth, mask).expand_as(depth)
    plane = torch.ones_like(depth)
    first, second = (geometry_scores(d, everywhere, depth, mask, fov_deg, normal) for d in (average, plane))
    return first, second


def predicted_depth(
    model: Any, images: np.ndarray, *, batch_size: int = 64, progress: Progress | None = None
) -> tuple[Float[Tensor, "n h w"], Bool[Tensor, "n h w"]]:
    """Depth and mask that a model predicts for uint8 images (N, 3, H, W), in each image's own view."""

    def see(batch: Tensor) -> tuple[Tensor, Tensor]:
        rendering = model.render(model.decompose(batch))
        return rendering.depth.cpu(), rendering.mask.cpu() > 0.5

    parts = map_batches(see, model, images, batch_size=batch_size, progress=progress)
    return torch.cat([depth for depth, _ in parts]), torch.cat([mask for _, mask in parts])


def evaluate_geometry(
    model: Any,
    truth: GroundTruth,
    *,
    batch_size: int = 64,
    untrained: Any = None,
    progress: Progress | None = None,
) -> GeometryResult:
    """A model's geometry on images with ground truth, beside average depth, plane and an untrained model.

    Args:
        model: with ``decompose``, ``render``, ``fov_deg``, ``image_size``, ``device``.
        truth: images with depth, normals and mask at the model's image size.
        batch_size: images at a time; changes speed and memory only.
        untrained: the same architecture with fresh weights, for the control.
        progress: called with (images done, images in all) after every batch of ``model``.
    """
    size = truth.images.shape[-1]
    if size != model.image_size:
        raise ValueError(
            f"the ground truth is {size} pixels wide, the model takes {model.image_size}: use its size"
        )
    depth, mask, normal = _truth(truth)

    def score(any_model: Any, report: Progress | None) -> GeometryScores:
        prediction = predicted_depth(any_model, truth.images, batch_size=batch_size, progress=report)
        return geometry_scores(*prediction, depth, mask, model.fov_deg, normal)

    average, plane = geometry_controls(truth, model.fov_deg)
    fresh = None if untrained is None else score(untrained, None)
    return GeometryResult(score(model, progress), average, plane, fresh)


def _truth(truth: GroundTruth) -> tuple[Tensor, Tensor, Tensor | None]:
    normal = (
        None if truth.normal is None else torch.nn.functional.normalize(torch.as_tensor(truth.normal), dim=-1)
    )
    return torch.as_tensor(truth.depth), torch.as_tensor(truth.mask) > 0, normal


def _where(mask: Tensor, values: Tensor) -> Tensor:
    return torch.where(mask, values, torch.zeros_like(values))


def _filled(depth: Tensor, mask: Tensor) -> Tensor:
    """Depth with a harmless 1 outside the mask; no scored pixel depends on it."""
    return torch.where(mask, depth, torch.ones_like(depth))


def _log(depth: Tensor, mask: Tensor) -> Tensor:
    return _filled(depth, mask).log()
