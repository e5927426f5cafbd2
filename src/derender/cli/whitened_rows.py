"""Rows that tell whitening from codes: codes not whitened, and controls whitened by a model's renderings."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from derender.cli.console import notice, progress_bar

if TYPE_CHECKING:
    from derender.cli.feature_rows import Source
    from derender.data import PictureSet
    from derender.evaluation.feature_rows import FeatureRow
    from derender.training.config import FeatureSettings


def whitened_rows(
    source: "Source", pictures: "PictureSet", factors: str, seeds: Sequence[int], whiten_on: str
) -> "list[FeatureRow]":
    """The model not whitened and whitened on ``whiten_on``; then the controls, whitened there too."""
    from derender.baselines.controls import untrained_twin
    from derender.cli.feature_rows import embedded, factors_of, remembered
    from derender.cli.models import open_model
    from derender.data import read_pictures
    from derender.evaluation.feature_rows import FeatureRow
    from derender.evaluation.whitened_controls import Lender, component_count, whitened, whitened_components

    assert source.model is not None
    net = open_model(source.model, source.device)
    settings = whitening_settings(source.model)
    wanted = settings.whitening.pictures
    if wanted < 2:
        raise ValueError(f"{source.model} was trained with whitening.pictures={wanted}: nothing to compare")
    with progress_bar("reading") as report:
        lent = read_pictures(whiten_on, net.image_size, limit=wanted, progress=report)
    lent = lent.require(20, "--whiten-on")
    notice(f"whitening is fitted to {len(lent):,} pictures of {lent.source}")
    lender = Lender(net, lent.images, settings, memory=source.memory)
    chosen, name, memory = factors_of(factors), source.row_name(factors), source.memory
    rows = []
    if net.whitening is not None:
        bare = net.without_features()
        rows.append(FeatureRow(f"{name}, not whitened", (embedded(bare, pictures, memory, "codes"),), chosen))
    with progress_bar("rendering again") as report:
        again = whitened(lender, net, report)
    table = embedded(again, pictures, memory, "embedding whitened")
    rows.append(FeatureRow(f"{name}, whitened here", (table,), chosen))
    tables = []
    for seed in seeds:
        with progress_bar(f"rendering again for untrained encoder {seed}") as report:
            twin = whitened(lender, untrained_twin(net, seed), report)
        table = embedded(twin, pictures, memory, f"whitened untrained encoder {seed}")
        tables.append(replace(table, origin={**table.origin, "control": "untrained", "seed": seed}))
    rows.append(FeatureRow("untrained encoder, whitened", tuple(tables), chosen, control=True))
    inputs = {"lent": lent.images, "images": pictures.images, "renders": rows[0].tables[0].origin["weights"]}
    with progress_bar("rendering again for PCA") as report:
        table = remembered(
            memory, "pca-whitened", {**inputs, "settings": settings.model_dump(mode="json")}, pictures,
            lambda: whitened_components(lender, pictures, progress=report),
        )  # fmt: skip
    rows.append(FeatureRow(f"PCA ({component_count(lent.images)}), whitened", (table,), control=True))
    return rows


def whitening_settings(model: str) -> "FeatureSettings":
    """How a run whitens, from its own configuration where it has one."""
    from derender.baselines import read_any_config
    from derender.training.config import FeatureSettings, TrainConfig

    if (Path(model) / "config.yaml").is_file():
        config = read_any_config(Path(model))
        if isinstance(config, TrainConfig):
            return config.features
    return FeatureSettings()
