"""Controls that every score of features stands beside, made of the same images under the same protocol.

Without learning: an untrained encoder of the same architecture (several seeds), principal components and
the pixels themselves. To separate whitening from codes there are controls whitened by a trained model's
renderings: an untrained model's show nothing, so it cannot whiten its own codes
(postprocess/whitening.py). The model lends its renderings of the same images, lightings and viewpoints,
described by an untrained encoder or by principal components. Leaves out whitened pixels: 12,288
directions cannot be estimated from 2,000 images.
"""

import copy
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, UInt8
from pydantic import ValidationError
from sklearn.decomposition import PCA
from torch import Tensor

from derender.baselines import read_any_config
from derender.baselines.controls import (
    DESCRIPTORS,
    control_table,
    flat_pixels,
    pca_features,
    pixel_features,
    untrained_twin,
)
from derender.data import ImageSet
from derender.evaluation.feature_rows import (
    FeatureRow,
    FeatureSource,
    check_rows,
    embedded_table,
    is_model,
    one_row,
)
from derender.evaluation.memory import Memory
from derender.evaluation.options import Options
from derender.evaluation.pixels import component_count
from derender.features import FeatureTable, model_fingerprint
from derender.inputs import Progress, as_images, as_model, device_named
from derender.model import Derenderer
from derender.postprocess import Features
from derender.postprocess.whitening import Whitening
from derender.presets import ModelSettings
from derender.training.config import FeatureSettings, TrainConfig
from derender.training.features import Describe, fit_whitening

UNTRAINED = "untrained encoder"
_SHOWN = {"gradientfaces": "Gradientfaces", "hog": "HOG", "lbp": "LBP"}


def subject_and_controls(features: FeatureSource, options: Options) -> list[FeatureRow]:
    """The row of one table or model, and behind it the controls of its images."""
    if options.whiten_on is None:
        return with_controls([one_row(features, options)], options)
    if not is_model(features):
        raise ValueError(
            "whiten_on needs a model that renders images, which a table of features cannot: give a model "
            "and its images"
        )
    model = as_model(features, device=options.device)
    subject, *controls = with_controls([one_row(model, options)], options)
    own, lent = whitened_rows(model, subject, options.whiten_on, options)
    return [subject, *own, *controls, *lent]


def with_controls(rows: Sequence[FeatureRow], options: Options) -> list[FeatureRow]:
    """The rows, and behind them the controls of their images; without images there are none."""
    check_rows(rows)
    if options.images is None:
        options.notes.append("without images there are no pixels, PCA and untrained encoder to compare with")
        return list(rows)
    settings = architecture(rows)
    size = 64 if settings is None else settings.network.image_size
    return [*rows, *control_rows(options.at(size, rows[0].tables[0].files), settings, options)]


def control_rows(
    images: ImageSet, settings: ModelSettings | None, options: Options, fit_on: ImageSet | None = None
) -> list[FeatureRow]:
    """The controls of every protocol on features: an untrained encoder, PCA and pixels.

    Without ``settings``, an architecture, there is no untrained encoder. PCA gets its components from
    ``fit_on``, by default ``images``.
    """
    rows = []
    if settings is not None:
        twins = {
            seed: Derenderer.seeded(settings, seed).to(device_named(options.device)).eval()
            for seed in options.seeds(options.untrained_seeds)
        }
        rows.append(_untrained_row(UNTRAINED, twins, images, options))
    fitted = images if fit_on is None else fit_on
    components = component_count(len(fitted))  # whitening needs many more rows than components
    inputs = {"images": images.images, "components": components}
    inputs |= {} if fit_on is None else {"fit_on": fit_on.images}
    pca = options.memory.recall_one(
        "pca", inputs, lambda: pca_features(images, components=components, fit_on=fitted).factors["pca"]
    )
    table = control_table(images, "pca", pca, {"components": components})
    rows.append(FeatureRow(f"PCA ({components})", (table,), control=True))
    options.notes.append(
        f"PCA ({components}), whitened, is fitted to {len(fitted):,} images of {fitted.source}"
    )
    rows.append(FeatureRow("pixels", (pixel_features(images),), control=True))
    for name, describe in DESCRIPTORS.items() if options.descriptors else ():
        try:
            table = describe(images, progress=options.stage(name))
        except ValueError as error:  # a package is missing, or images are smaller than a cell
            options.notes.append(f"{name} left out: {error}")
        else:
            rows.append(FeatureRow(_SHOWN[name], (table,), control=True))
    return rows


def _untrained_row(
    name: str, encoders: Mapping[int, Derenderer], images: ImageSet, options: Options
) -> FeatureRow:
    tables = []
    for seed, encoder in encoders.items():
        table = embedded_table(encoder, images, options.memory, options.stage(f"{UNTRAINED} {seed}"))
        tables.append(replace(table, origin={**table.origin, "control": "untrained", "seed": seed}))
    return FeatureRow(name, tuple(tables), options.chosen, control=True)


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


def whitened_rows(
    model: Derenderer, subject: FeatureRow, whiten_on: ImageSet | str | Path, options: Options
) -> tuple[list[FeatureRow], list[FeatureRow]]:
    """The model with and without whitening fitted to other images; and the controls, whitened there too."""
    settings = _whitening_settings(model)
    lent = as_images(
        whiten_on, model.image_size, limit=settings.whitening.pictures, at_least=20,
        progress=options.stage("reading"),
    )  # fmt: skip
    options.notes.append(f"whitening is fitted to {len(lent):,} images of {lent.source}")
    images = options.at(model.image_size, subject.tables[0].files)
    renderings = Renderings(model, lent.images, settings, options.memory)

    def row(what: str, encoder: Derenderer) -> FeatureRow:
        table = embedded_table(encoder, images, options.memory, options.stage(f"embedding {what}"))
        return FeatureRow(f"{subject.name}, {what}", (table,), options.chosen)

    own = [row("not whitened", model.without_features())] if model.whitening is not None else []
    own.append(row("whitened here", renderings.whiten(model, options.stage("rendering for the model"))))
    twins = {
        seed: renderings.whiten(
            untrained_twin(model, seed), options.stage(f"rendering for {UNTRAINED} {seed}")
        )
        for seed in options.seeds(options.untrained_seeds)
    }
    pca = renderings.components(images, options.stage("rendering for PCA"))
    controls = [
        _untrained_row(f"{UNTRAINED}, whitened", twins, images, options),
        FeatureRow(f"PCA ({renderings.n_components}), whitened", (pca,), control=True),
    ]
    return own, controls


@dataclass(frozen=True)
class Renderings:
    """A trained model and (n, 3, S, S) images, best those of its training, whose renderings whiten codes.

    The model's own whitening plays no part. ``settings`` hold the numbers of images and views, the
    perturbation and the directions kept.
    """

    model: Derenderer
    images: UInt8[np.ndarray, "n 3 s s"]
    settings: FeatureSettings
    memory: Memory = field(default_factory=Memory)

    @property
    def n_components(self) -> int:
        """256 principal components, and at most a quarter of the number of images."""
        return component_count(len(self.images), most=256)

    def whiten(self, encoder: Derenderer, progress: Progress | None = None) -> Derenderer:
        """A copy of an encoder whose geometry and albedo are whitened by the renderings; its scenes stay."""
        names = [factor.name for factor in encoder.factors if factor.mirrored]
        result = copy.deepcopy(encoder.without_features()).eval()  # mirror images are views here
        describe = result.activations if self.settings.whitening.spatial else result.encode

        def described(images: Float[Tensor, "n 3 h w"]) -> dict[str, Tensor]:
            output = describe(images.to(result.device))
            return {name: output[name] for name in names}

        size = encoder.settings.network.code_size
        whitening = self._fitted(described, f"{model_fingerprint(result)} {size}", progress, size)
        features = Features(whitening.to(result.device), encoder.fitting)
        return result.with_features(features).train(encoder.training)

    def components(self, images: ImageSet, progress: Progress | None = None) -> FeatureTable:
        """Principal components of the lent images, whitened by their renderings: factor ``pca``."""
        count = self.n_components
        pca = PCA(count, random_state=0).fit(flat_pixels(self.images))

        def described(batch: Float[Tensor, "n 3 h w"]) -> dict[str, Tensor]:
            return {"pca": torch.from_numpy(pca.transform(batch.numpy(force=True).reshape(len(batch), -1)))}

        whitening = self._fitted(described, f"pca {count} None", progress)
        views = [images.images, images.images[..., ::-1]] if whitening.mirrored else [images.images]
        codes = torch.cat([torch.from_numpy(pca.transform(flat_pixels(one))) for one in views], dim=1)
        origin = {"components": count, "whitened": True, "fitted_on": len(self.images)}
        return control_table(images, "pca", whitening({"pca": codes})["pca"].numpy(), origin)

    def _fitted(
        self, describe: Describe, mark: str, progress: Progress | None, size: int | None = None
    ) -> Whitening:
        """The whitening of what ``describe`` gives for the renderings, cached."""
        settings, bare = self.settings, self.model.without_features()
        inputs = {
            "renders": model_fingerprint(bare), "images": self.images, "describes": mark, "seed": 0,
            "settings": settings.model_dump(mode="json"),
        }  # fmt: skip

        def make() -> dict[str, np.ndarray]:
            result = fit_whitening(
                bare, torch.from_numpy(self.images), settings.whitening, settings.perturb,
                describe=describe, size=size, progress=progress,
            )  # fmt: skip
            return {name: value.cpu().numpy() for name, value in result.named_buffers()}

        arrays = self.memory.recall("lent whitening", inputs, make)
        return Whitening.of({name: torch.from_numpy(values) for name, values in arrays.items()})


def _whitening_settings(model: Derenderer) -> FeatureSettings:
    """How a run whitens, from its own configuration where it has one."""
    settings, folder = FeatureSettings(), Path(str(model.source))
    folder = folder.parent if folder.name == "model" else folder
    if (folder / "config.yaml").is_file():
        config = read_any_config(folder)
        settings = config.features if isinstance(config, TrainConfig) else settings
    if settings.whitening.pictures < 2:
        raise ValueError(f"{folder} was trained without whitening: nothing to compare")
    return settings
