"""Rows of features that learned nothing, beside which every protocol shows its scores.

An untrained encoder of the same architecture (several seeds), principal components and the pixels themselves;
and, to separate whitening from codes, controls whitened by a trained model's renderings.

The whitening (postprocess/whitening.py) learns from renderings of the same scene under other lighting and
viewpoints. An untrained model's renderings show nothing, so it cannot whiten its own codes. A trained model
lends its renderings: the same images, lightings and viewpoints, described by an untrained encoder or by
principal components, and whitened by the same rule. Leaves out whitened pixels: 12,288 directions cannot be
estimated from 2,000 images, so 256 components are in their place.
"""

import copy
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, UInt8
from pydantic import ValidationError
from sklearn.decomposition import PCA
from torch import Tensor

from derender.baselines import read_any_config
from derender.baselines.controls import control_table, pca_features, pixel_features, untrained_twin
from derender.data import ImageSet
from derender.evaluation.feature_rows import (
    FeatureRow,
    FeatureSource,
    SizedImages,
    StageProgress,
    aligned,
    cached_table,
    check_rows,
    embedded_table,
    is_model,
    one_row,
    stage,
)
from derender.evaluation.memory import Memory
from derender.features import FeatureTable, model_fingerprint
from derender.inputs import Progress, as_images, as_model, device_named
from derender.model import Derenderer
from derender.postprocess import Features
from derender.postprocess.whitening import Projection, Whitening
from derender.presets import ModelSettings
from derender.training.config import FeatureSettings, TrainConfig
from derender.training.features import Describe, fit_whitening

UNTRAINED = "untrained encoder"
MISSING_CONTROLS = "without images there are no pixels, PCA and untrained encoder to compare with"
DEFAULT_SIZE = 64  # of the controls beside features of an unknown architecture
COMPONENTS, LENT_COMPONENTS = 64, 256


def subject_and_controls(
    features: FeatureSource,
    images: SizedImages | None,
    factors: Sequence[str] | None,
    seeds: Sequence[int],
    *,
    memory: Memory,
    device: str = "auto",
    whiten_on: ImageSet | str | Path | None = None,
    progress: StageProgress | None = None,
) -> list[FeatureRow]:
    """The row of one table or model, and behind it the controls of its images.

    Args:
        features: a table or its ``.parquet`` file; a model or its name.
        images: of the model, and of the controls; without them there are none.
        factors: features to use; None means all.
        seeds: untrained encoders.
        memory: where features are cached.
        device: of models.
        whiten_on: images that ``whitened_rows`` are made with, too.
        progress: called while reading and embedding.
    """
    if whiten_on is not None:
        if not is_model(features):
            raise ValueError(
                "whiten_on needs a model that renders images, which a table of features cannot: give a model "
                "and its images"
            )
        features = as_model(features, device=device)
    row = one_row(features, factors, images, memory=memory, device=device, progress=progress)
    rows = with_controls([row], images, factors, seeds, memory=memory, device=device, progress=progress)
    if whiten_on is None or images is None:
        return rows
    assert isinstance(features, Derenderer)
    settings = _whitening_settings(features)
    lent = as_images(
        whiten_on, features.image_size, limit=settings.whitening.pictures, at_least=20,
        progress=stage(progress, "reading"),
    )  # fmt: skip
    images.notes.append(f"whitening is fitted to {len(lent):,} images of {lent.source}")
    more = whitened_rows(
        features, row.name, aligned(images.at(features.image_size), row.tables[0].files), lent, settings,
        factors, seeds, memory=memory, progress=progress,
    )  # fmt: skip
    own, others = ([one for one in more if one.control is control] for control in (False, True))
    return [row, *own, *rows[1:], *others]


def with_controls(
    rows: Sequence[FeatureRow],
    images: SizedImages | None,
    factors: Sequence[str] | None,
    seeds: Sequence[int],
    *,
    memory: Memory,
    device: str = "auto",
    progress: StageProgress | None = None,
) -> list[FeatureRow]:
    """The rows, and behind them the controls of their images; without images there are none."""
    check_rows(rows)
    if images is None:
        return list(rows)
    settings = architecture(rows)
    size = DEFAULT_SIZE if settings is None else settings.network.image_size
    own = aligned(images.at(size), rows[0].tables[0].files)
    controls = control_rows(own, settings, factors, seeds, memory=memory, device=device, progress=progress)
    return [*rows, *controls]


def image_notes(images: SizedImages | None) -> list[str]:
    """Sentences on the images that were read, or on the controls that are missing without them."""
    return [MISSING_CONTROLS] if images is None else list(images.notes)


def control_rows(
    images: ImageSet,
    settings: ModelSettings | None,
    factors: Sequence[str] | None,
    seeds: Sequence[int],
    *,
    memory: Memory,
    device: str = "auto",
    fit_on: ImageSet | None = None,
    progress: StageProgress | None = None,
) -> list[FeatureRow]:
    """The controls of every protocol on features: an untrained encoder, PCA and pixels.

    Args:
        images: to describe.
        settings: the architecture of the untrained encoder; without it there is no such row.
        factors: features of the encoder to use; None means all.
        seeds: one untrained encoder each.
        memory: where features are cached.
        device: of the encoders.
        fit_on: images that give PCA its components; by default ``images``.
        progress: called while embedding.
    """
    chosen, rows = None if factors is None else tuple(factors), []
    if settings is not None:
        tables = []
        for seed in seeds:
            twin = Derenderer.seeded(settings, seed).to(device_named(device)).eval()
            table = embedded_table(twin, images, memory, stage(progress, f"{UNTRAINED} {seed}"))
            tables.append(_as_untrained(table, seed))
        rows.append(FeatureRow(UNTRAINED, tuple(tables), chosen, control=True))
    fitted = images if fit_on is None else fit_on
    components = max(1, min(COMPONENTS, len(fitted) // 4))  # whitening needs many more rows than components
    inputs = {"images": images.images, "components": components}
    if fit_on is not None:
        inputs["fit_on"] = fit_on.images
    pca = cached_table(
        memory, "pca", inputs, images, lambda: pca_features(images, components=components, fit_on=fitted)
    )
    rows.append(FeatureRow(f"PCA ({components})", (pca,), control=True))
    rows.append(FeatureRow("pixels", (pixel_features(images),), control=True))
    return rows


def architecture(rows: Sequence[FeatureRow]) -> ModelSettings | None:
    """The model settings of the first row that a ``Derenderer`` made; None if there is none."""
    for row in rows:
        origin = row.tables[0].origin
        own = origin.get("model", Derenderer.__name__) == Derenderer.__name__
        stored = origin.get("settings") if own else None
        if stored is not None and not row.control:
            try:
                return ModelSettings.model_validate(stored)
            except ValidationError as error:
                first = error.errors()[0]
                raise ValueError(
                    f"features {row.name!r} were made by a model this version does not know "
                    f"({'.'.join(map(str, first['loc']))}: {first['msg']}): embed the data again"
                ) from error
    return None


@dataclass(frozen=True)
class Renderings:
    """A trained model and the images whose renderings whiten the codes of other encoders.

    Attributes:
        model: renders; its own whitening plays no part.
        images: (n, 3, S, S) images at the model's size, best those of its training.
        settings: the numbers of images and views, the perturbation, the directions kept.
        seed: of the renderings: the same for every encoder.
        memory: where whitenings are cached.
    """

    model: Derenderer
    images: UInt8[np.ndarray, "n 3 s s"]
    settings: FeatureSettings
    seed: int = 0
    memory: Memory | None = None


def whitened_rows(
    model: Derenderer,
    name: str,
    images: ImageSet,
    lent: ImageSet,
    settings: FeatureSettings,
    factors: Sequence[str] | None,
    seeds: Sequence[int],
    *,
    memory: Memory,
    progress: StageProgress | None = None,
) -> list[FeatureRow]:
    """The model with and without whitening fitted to ``lent``; then the controls, whitened there too."""
    chosen = None if factors is None else tuple(factors)
    renderings = Renderings(model, lent.images, settings, memory=memory)
    rows = []
    if model.whitening is not None:
        table = embedded_table(model.without_features(), images, memory, stage(progress, "embedding codes"))
        rows.append(FeatureRow(f"{name}, not whitened", (table,), chosen))

    def embedded(encoder: Derenderer, what: str) -> FeatureTable:
        own = whitened(renderings, encoder, stage(progress, f"rendering for {what}"))
        return embedded_table(own, images, memory, stage(progress, f"embedding {what}"))

    rows.append(FeatureRow(f"{name}, whitened here", (embedded(model, "the model"),), chosen))
    tables = [
        _as_untrained(embedded(untrained_twin(model, seed), f"{UNTRAINED} {seed}"), seed) for seed in seeds
    ]
    rows.append(FeatureRow(f"{UNTRAINED}, whitened", tuple(tables), chosen, control=True))
    inputs = {
        "lent": lent.images, "images": images.images,
        "renders": rows[0].tables[0].origin["weights"], "settings": settings.model_dump(mode="json"),
    }  # fmt: skip
    pca = cached_table(
        memory, "pca-whitened", inputs, images,
        lambda: whitened_components(renderings, images, stage(progress, "rendering for PCA")),
    )  # fmt: skip
    rows.append(FeatureRow(f"PCA ({component_count(lent.images)}), whitened", (pca,), control=True))
    return rows


def whitened(renderings: Renderings, encoder: Derenderer, progress: Progress | None = None) -> Derenderer:
    """A copy of an encoder whose geometry and albedo are whitened by the renderings; its scenes stay."""
    names = [factor.name for factor in encoder.factors if factor.mirrored]
    spatial, size = renderings.settings.whitening.spatial, encoder.settings.network.code_size
    found = copy.deepcopy(encoder.without_features()).eval()  # mirror images are views here

    def describe(images: Float[Tensor, "n 3 h w"]) -> dict[str, Tensor]:
        output = (found.activations if spatial else found.encode)(images.to(found.device))
        return {name: output[name] for name in names}

    whitening = _fitted(renderings, describe, model_fingerprint(found), progress, size).to(found.device)
    return found.with_features(Features(whitening, encoder.fitting)).train(encoder.training)


def component_count(images: np.ndarray) -> int:
    """The number of components for (n, 3, S, S) images: 256, and at most a quarter of their number."""
    return max(1, min(LENT_COMPONENTS, len(images) // 4))


def whitened_components(
    renderings: Renderings, images: ImageSet, progress: Progress | None = None
) -> FeatureTable:
    """Principal components of the images that lend their renderings, whitened by these: factor ``pca``."""
    count = component_count(renderings.images)
    pca = PCA(count, random_state=0).fit(_flat(renderings.images))
    mean = torch.from_numpy(pca.mean_).float()
    components: Any = pca.components_
    axes = torch.from_numpy(components.T.copy()).float()

    def projected(flat: Float[Tensor, "n pixel"]) -> Float[Tensor, "n component"]:
        return (flat - mean) @ axes

    def describe(batch: Float[Tensor, "n 3 h w"]) -> dict[str, Tensor]:
        return {"pca": projected(batch.detach().cpu().float().flatten(1))}

    whitening = _fitted(renderings, describe, f"pca {count}", progress)
    views = [images.images, images.images[..., ::-1]] if whitening.mirrored else [images.images]
    codes = torch.cat([projected(torch.from_numpy(_flat(one))) for one in views], dim=1)
    origin = {"control": "pca", "components": count, "whitened": True, "fitted_on": len(renderings.images)}
    return control_table(images, "pca", whitening({"pca": codes})["pca"].numpy(), origin)


def _fitted(
    renderings: Renderings, describe: Describe, mark: str, progress: Progress | None, size: int | None = None
) -> Whitening:
    """The whitening of what ``describe`` gives for the renderings, cached."""
    settings, bare = renderings.settings, renderings.model.without_features()
    inputs = {
        "renders": model_fingerprint(bare), "images": renderings.images, "describes": f"{mark} {size}",
        "seed": renderings.seed, "settings": settings.model_dump(mode="json"),
    }  # fmt: skip

    def make() -> dict[str, np.ndarray]:
        found = fit_whitening(
            bare, torch.from_numpy(renderings.images), settings.whitening, settings.perturb,
            describe=describe, size=size, seed=renderings.seed, progress=progress,
        )  # fmt: skip
        return {name: value.cpu().numpy() for name, value in found.named_buffers()}

    arrays = (renderings.memory or Memory()).recall("lent whitening", inputs, make)
    names = [name.removesuffix("_map") for name in arrays if name.endswith("_map")]
    parts = ("mean", "map", "ratios")
    contrasts = {
        name: Projection(*(torch.from_numpy(arrays[f"{name}_{part}"]) for part in parts)) for name in names
    }
    return Whitening(contrasts, mirrored=names if settings.whitening.mirrored else ())


def _whitening_settings(model: Derenderer) -> FeatureSettings:
    """How a run whitens, from its own configuration where it has one."""
    settings, folder = FeatureSettings(), Path(str(model.source))
    folder = folder.parent if folder.name == "model" else folder
    if (folder / "config.yaml").is_file():
        config = read_any_config(folder)
        settings = config.features if isinstance(config, TrainConfig) else settings
    if settings.whitening.pictures < 2:
        raise ValueError(
            f"{folder} was trained with whitening.pictures={settings.whitening.pictures}: nothing to compare"
        )
    return settings


def _as_untrained(table: FeatureTable, seed: int) -> FeatureTable:
    return replace(table, origin={**table.origin, "control": "untrained", "seed": seed})


def _flat(images: np.ndarray) -> np.ndarray:
    return np.asarray(images, np.float32).reshape(len(images), -1) / 255
