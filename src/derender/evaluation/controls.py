"""Controls that every score of features stands beside, made of the same images under the same protocol.

Without learning: an untrained encoder of the same architecture (several seeds), principal components and
the pixels themselves. Tables of identity and class also have descriptors, of the image alone and averaged
with those of its mirror image: whitened features see both.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from pydantic import ValidationError

from derender.baselines.controls import control_table, descriptor_features, pca_features, pixel_features
from derender.data import ImageSet
from derender.evaluation.feature_rows import FeatureRow, FeatureSource, check_rows, embedded_table, one_row
from derender.evaluation.options import Options
from derender.evaluation.pixels import component_count
from derender.inputs import device_named
from derender.model import Derenderer
from derender.presets import ModelSettings

UNTRAINED = "untrained encoder"
DESCRIPTORS_SHOWN = {"gradientfaces": "Gradientfaces", "hog": "HOG", "lbp": "LBP"}


def subject_and_controls(features: FeatureSource, options: Options) -> list[FeatureRow]:
    """The row of one table or model, and behind it the controls of its images."""
    return with_controls([one_row(features, options)], options)


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
    rows, tables = [], []
    if settings is not None:
        for seed in options.seeds(options.untrained_seeds):
            encoder = Derenderer.seeded(settings, seed).to(device_named(options.device)).eval()
            table = embedded_table(encoder, images, options.memory, options.stage(f"{UNTRAINED} {seed}"))
            tables.append(replace(table, origin={**table.origin, "control": "untrained", "seed": seed}))
        rows.append(FeatureRow(UNTRAINED, tuple(tables), options.chosen, control=True))
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
    for name, shown in DESCRIPTORS_SHOWN.items() if options.descriptors else ():
        try:
            table = descriptor_features(name, images, progress=options.stage(name))
            mirrored = replace(images, images=np.ascontiguousarray(images.images[..., ::-1]))
            other = descriptor_features(name, mirrored, progress=options.stage(f"{name} of mirror images"))
        except ValueError as error:  # a package is missing, or images are smaller than a cell
            options.notes.append(f"{name} left out: {error}")
        else:
            both = replace(table, factors={name: (table.factors[name] + other.factors[name]) / 2})
            rows.append(FeatureRow(shown, (table,), control=True))
            rows.append(FeatureRow(f"{shown} with mirror image", (both,), control=True))
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
