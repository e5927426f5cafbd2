"""Controls with the whitening of a trained model: how much of a score is the whitening, how much the codes?

The whitening (postprocess/whitening.py) learns from renderings of the same scene in other light and from
other sides. An untrained model's renderings show nothing, so it cannot whiten its own codes. What can be lent
is the trained model's renderings: the same pictures, the same light, the same sides, described by an
untrained encoder or by principal components of their pixels, and whitened by the same rule. Such a control
knows what light and camera do to its codes as well as the model does; what is left between them is what the
codes hold. Leaves out pixels as they are: 12,288 directions cannot be told from 2,000 pictures, so 256
components stand for them, as many as a factor's code has numbers.
"""

import copy
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, UInt8
from sklearn.decomposition import PCA
from torch import Tensor

from derender.baselines.controls import control_table
from derender.data import PictureSet
from derender.evaluation.memory import Memory
from derender.features import FeatureTable, model_fingerprint
from derender.model import Derenderer
from derender.postprocess import Features
from derender.postprocess.whitening import Contrast, Whitening
from derender.training.config import FeatureSettings
from derender.training.features import Describe, fit_whitening

COMPONENTS = 256

Progress = Callable[[int, int], None]


@dataclass(frozen=True)
class Lender:
    """A trained model and the pictures that it renders again.

    Attributes:
        model: renders; its own whitening plays no part.
        images: (n, 3, S, S) pictures at the model's size, best those it was trained on.
        settings: how many pictures and views, what is perturbed, how many directions are kept.
        seed: of the renderings: the same for every borrower.
        memory: where what was fitted is kept.
    """

    model: Derenderer
    images: UInt8[np.ndarray, "n 3 s s"]
    settings: FeatureSettings
    seed: int = 0
    memory: Memory | None = None


def whitened(lender: Lender, encoder: Derenderer, progress: Progress | None = None) -> Derenderer:
    """A copy of an encoder (the lender's own model, or an untrained one of its kind), whitened by the lender.

    Its features of geometry and albedo are whitened; scenes stay what they were.
    """
    names = [factor.name for factor in encoder.factors if factor.mirrored]
    spatial, size = lender.settings.whitening.spatial, encoder.settings.network.code_size
    found = copy.deepcopy(encoder.without_features()).eval()  # mirror images are views here

    def describe(pictures: Float[Tensor, "n 3 h w"]) -> dict[str, Tensor]:
        said = (found.activations if spatial else found.encode)(pictures.to(found.device))
        return {name: said[name] for name in names}

    whitening = _fitted(lender, describe, model_fingerprint(found), progress, size).to(found.device)
    return found.with_features(Features(whitening, encoder.fitting)).train(encoder.training)


def component_count(images: np.ndarray) -> int:
    """How many components (n, 3, S, S) pictures give: 256, and at most a quarter of their number."""
    return max(1, min(COMPONENTS, len(images) // 4))


def whitened_components(
    lender: Lender, pictures: PictureSet, progress: Progress | None = None
) -> FeatureTable:
    """Principal components of the lender's pictures, whitened by its renderings: factor ``pca``.

    Args:
        lender: renders; the components (``component_count``) are those of its pictures too.
        pictures: to describe, at the same size.
        progress: called with (pictures rendered again, pictures in all).
    """
    count = component_count(lender.images)
    pca = PCA(count, random_state=0).fit(_flat(lender.images))
    mean = torch.from_numpy(pca.mean_).float()
    components = np.asarray(pca.components_)
    axes = torch.from_numpy(components.T.copy()).float()

    def describe(batch: Float[Tensor, "n 3 h w"]) -> dict[str, Tensor]:
        return {"pca": projected(batch.detach().cpu().float().flatten(1))}

    def projected(flat: Float[Tensor, "n pixel"]) -> Float[Tensor, "n component"]:
        return (flat - mean) @ axes

    whitening = _fitted(lender, describe, f"pca {count}", progress)
    seen = [pictures.images]
    if whitening.mirrored:
        seen.append(pictures.images[..., ::-1])
    codes = torch.cat([projected(torch.from_numpy(_flat(one))) for one in seen], dim=1)
    origin = {"control": "pca", "components": count, "whitened": True, "fitted_on": len(lender.images)}
    return control_table(pictures, "pca", whitening({"pca": codes})["pca"].numpy(), origin)


def _fitted(
    lender: Lender, describe: Describe, mark: str, progress: Progress | None, size: int | None = None
) -> Whitening:
    """The whitening of what ``describe`` says of the lender's renderings, remembered."""
    settings = lender.settings
    bare = lender.model.without_features()
    inputs = {
        "renders": model_fingerprint(bare), "images": lender.images, "describes": f"{mark} {size}",
        "seed": lender.seed, "settings": settings.model_dump(mode="json"),
    }  # fmt: skip

    def make() -> dict[str, np.ndarray]:
        found = fit_whitening(
            bare,
            torch.from_numpy(lender.images),
            settings.whitening,
            settings.perturb,
            describe=describe,
            size=size,
            seed=lender.seed,
            progress=progress,
        )
        return {name: value.cpu().numpy() for name, value in found.named_buffers()}

    kept = (lender.memory or Memory()).recall("lent whitening", inputs, make)
    names = [name.removesuffix("_map") for name in kept if name.endswith("_map")]
    return Whitening(
        {
            name: Contrast(*(torch.from_numpy(kept[f"{name}_{part}"]) for part in ("mean", "map", "ratios")))
            for name in names
        },
        mirrored=names if settings.whitening.mirrored else (),
    )


def _flat(images: np.ndarray) -> np.ndarray:
    return np.asarray(images, np.float32).reshape(len(images), -1) / 255
