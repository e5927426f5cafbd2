"""Encoder activations to features: linear discriminant analysis (LDA) without labels.

The classes are images; the members of a class are renderings of its scene with the other factors changed.
Within-class covariance normalisation divides each direction by how much renderings of one image differ in it.
The most discriminative directions are kept and made more even (training/features.py renders).
"""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor, nn

from derender.postprocess.framing import Framing
from derender.storage.tensors import read_tensors, write_tensors

_MIRRORED = "reads_mirror_image"  # in a file: maps take images with their mirror images
_CANONICAL = "_canonical"  # after a factor's name: its map takes the canonical view's activations
_FRAMING = "framing."  # before the names of the framing network's tensors
_ALONE = "_alone"  # after a factor's name, beside the former: this one takes images alone
_NEVER_SINGULAR = 1e-9  # share of the mean variance that is added at least: Cholesky's root must exist
_TINY = torch.finfo(torch.float32).tiny


@dataclass(frozen=True)
class Projection:
    """An affine map of one factor's activations: ``mean`` is subtracted, ``map`` multiplied from the right.

    ``ratios`` of every direction kept, largest first: variance between images over variance within them.
    """

    mean: Float[Tensor, " input"]
    map: Float[Tensor, "input code"]
    ratios: Float[Tensor, " directions"]


class Scatter:
    """Within-class and between-class covariance, one class an image, of so many views of ``count`` images."""

    def __init__(self) -> None:
        self.views = self.count = 0
        self._within = self._centres = self._centre = torch.zeros((), dtype=torch.float64)

    def add(self, activations: Float[Tensor, "views n input"]) -> "Scatter":
        """More images, each with as many views as those before; gives the scatter itself."""
        self.views = len(activations)
        self.count += activations.shape[1]
        centres = activations.double().mean(dim=0)
        apart = (activations - centres.to(activations)).flatten(0, 1)
        self._within = self._within + (apart.T @ apart).double()
        self._centres = self._centres + centres.T @ centres
        self._centre = self._centre + centres.sum(dim=0)
        return self

    @property
    def mean(self) -> Float[Tensor, " input"]:
        """Of the class means."""
        return self._centre / self.count

    @property
    def within(self) -> Float[Tensor, "input input"]:
        """Within-class covariance, the mean over images, unbiased."""
        return self._within / (self.count * (self.views - 1))

    @property
    def between(self) -> Float[Tensor, "input input"]:
        """Covariance of the class means."""
        return self._centres / self.count - torch.outer(self.mean, self.mean)


def fit_projection(
    scatter: Scatter, directions: int, shrinkage: float, size: int | None = None, evenness: float = 0.0,
    power: float = 0.0,
) -> Projection:  # fmt: skip
    """The map that makes the mean within-class variance 1 in every kept direction, or evens out the total.

    Features are rotated so that each is as near as can be to the number of the code in its place.

    Args:
        scatter: of activations in which the code comes first; fewer than two views or images: a ValueError.
        directions: how many are kept, those with the largest ratio between over within; at most ``size``.
        shrinkage: share of the mean within-class variance that is added to every direction's.
        size: of the code, and of the features; by default that of the activations.
        evenness: 0..1. At 0 a direction in which images differ more counts for more; at 1 all count alike.
        power: of each direction's repeatability, between / (between + within), by which it is weighted: at 1
            the posterior mean. At 0 kept directions are weighted alike.
    """
    from scipy.linalg import eigh  # only the kept directions: torch would find all, three times as slow

    if scatter.views < 2 or scatter.count < 2:
        got = f"got {scatter.views} of {scatter.count}"
        raise ValueError(f"whitening needs at least 2 views of 2 images, {got}")
    mean, within, between = scatter.mean, scatter.within, scatter.between
    width = len(mean)
    size = size or width
    floor = within.diagonal().mean().clamp(min=_TINY)
    within = within + max(shrinkage, _NEVER_SINGULAR) * floor * torch.eye(width).to(within)
    largest = [width - min(directions, size, width), width - 1]
    result = eigh(between.cpu().numpy(), within.cpu().numpy(), subset_by_index=largest)
    ratios, kept = (torch.tensor(part).to(within).flip(-1) for part in result)
    kept = kept * (2 / (1 + ratios)) ** (evenness / 2)  # 1 within and as much between are the 2
    positive = ratios.clamp(min=_TINY)
    kept = kept * (positive / (1 + positive)) ** power
    left, _, right = torch.linalg.svd(kept.T @ (within + between)[:, :size], full_matrices=False)
    return Projection(mean.float(), (kept @ left @ right).float(), ratios.float())


def fit_side_by_side(
    scatters: Sequence[Scatter], directions: int, shrinkage: float, size: int, evenness: float
) -> Projection:
    """One map of several activations side by side, each into its share of ``size`` features.

    Arguments are as of `fit_projection`. The features of all have as much variance as those of the first.
    """
    sizes = [(size + place) // len(scatters) for place in range(len(scatters))]
    pairs = zip(scatters, sizes, strict=True)
    fitted = [fit_projection(one, directions, shrinkage, own, evenness) for one, own in pairs]
    maps, spreads = [own.map.double() for own in fitted], [one.within + one.between for one in scatters]
    both = zip(maps, spreads, strict=True)
    totals = [(own.T @ spread @ own).trace().clamp(min=_TINY) for own, spread in both]
    scaled = [own * (totals[0] / total).sqrt() for own, total in zip(maps, totals, strict=True)]
    means, ratios = (torch.cat([getattr(own, part) for own in fitted]) for part in ("mean", "ratios"))
    return Projection(means, torch.block_diag(*scaled).float(), ratios.sort(descending=True).values)


class Whitening(nn.Module):
    """The projections of some factors, applied to activations by name; gives those factors' features alone.

    A projection takes the first of the activations, as many as it has rows. Those of names in ``canonical``
    take the last, of the image's canonical view. Those of names in ``mirrored`` take the mean over an image
    and its mirror image, whose activations follow: with a ``framing`` the last, of the image in its crop.
    """

    def __init__(
        self, projections: Mapping[str, Projection], *, mirrored: Collection[str] = (),
        canonical: Collection[str] = (), framing: Framing | None = None,
    ):  # fmt: skip
        super().__init__()
        self.names = tuple(projections)
        self.mirrored = frozenset(mirrored) & frozenset(projections)
        self.canonical = frozenset(canonical) & frozenset(projections)
        self.framing = framing
        tensors = {_MIRRORED: torch.ones(1)} if self.mirrored else {}
        tensors |= {f"{name}{_CANONICAL}": torch.ones(1) for name in self.canonical}
        for name, own in projections.items():
            if self.mirrored and name not in self.mirrored:
                tensors[f"{name}{_ALONE}"] = torch.ones(1)
            tensors |= {f"{name}_{part}": value for part, value in vars(own).items()}
        for name, value in tensors.items():
            self.register_buffer(name, value, persistent=False)

    @property
    def moved(self) -> frozenset[str]:
        """Names whose features are made of the image in another crop or view."""
        return self.canonical | (self.mirrored if self.framing is not None else frozenset())

    def forward(self, activations: Mapping[str, Float[Tensor, "n _"]]) -> dict[str, Float[Tensor, "n _"]]:
        taken = {name: self.inputs(name, activations[name]) for name in self.names if name in activations}
        buffer = self.get_buffer
        return {name: (own - buffer(f"{name}_mean")) @ buffer(f"{name}_map") for name, own in taken.items()}

    def size(self, name: str) -> int:
        """How many activations of an image a factor's projection takes."""
        return len(self.get_buffer(f"{name}_mean"))

    def inputs(self, name: str, activations: Float[Tensor, "n _"]) -> Float[Tensor, "n input"]:
        """What a factor's projection is applied to, of its activations."""
        size, mirrored = self.size(name), name in self.mirrored
        needed = size * (2 if mirrored else 1)
        if activations.shape[1] < needed:
            got = f"got {activations.shape[1]:,}: give what model.activations gives, not codes"
            raise ValueError(f"features of {name} are made of {needed:,} numbers, {got}")
        if mirrored:
            activations = activations.unflatten(1, (2, -1)).mean(dim=1)
        return (activations[:, -size:] if name in self.moved else activations[:, :size]).float()

    def save(self, file: Path) -> None:
        """Write the projections; complete or not at all."""
        write_tensors(dict(self.named_buffers()), file)

    @classmethod
    def load(cls, file: Path) -> "Whitening":
        """Read what ``save`` wrote; damage, or tensors that are missing or do not fit, is a ValueError."""
        return cls.of(read_tensors(file))

    @classmethod
    def of(cls, tensors: Mapping[str, Tensor]) -> "Whitening":
        """The projections whose ``named_buffers`` these are; one that does not fit is a ValueError."""
        projections = {}
        for name in [key.removesuffix("_map") for key in tensors if key.endswith("_map")]:
            try:
                mean, axes, ratios = (tensors[f"{name}_{part}"].float() for part in ("mean", "map", "ratios"))
            except KeyError as error:
                raise ValueError(f"it has no {error.args[0]!r}") from error
            if axes.ndim != 2 or len(axes) != len(mean) or ratios.ndim != 1:
                raise ValueError(f"{name}: a map of {tuple(axes.shape)} beside a mean of {len(mean)}")
            projections[name] = Projection(mean, axes, ratios)
        alone = {name for name in projections if f"{name}{_ALONE}" in tensors or _MIRRORED not in tensors}
        canonical = {name for name in projections if f"{name}{_CANONICAL}" in tensors}
        own = {key.removeprefix(_FRAMING): tensors[key] for key in tensors if key.startswith(_FRAMING)}
        framing = Framing(own) if own else None
        return cls(projections, mirrored=projections.keys() - alone, canonical=canonical, framing=framing)
