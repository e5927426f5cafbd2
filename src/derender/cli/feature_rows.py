"""Old names of evaluation/feature_rows.py and controls.py, for commands that are not rewritten yet."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from derender.cli.console import notice, progress_bar, report_images
from derender.cli.scoring import (
    Cache,
    Factors,
    MaxCount,
    MinCount,
    Resamples,
    UntrainedSeeds,
    named_paths,
    names_of,
    numbers_of,
)

__all__ = ["Cache", "Factors", "MaxCount", "MinCount", "Resamples", "UntrainedSeeds", "named_paths"]
factors_of, whole_numbers = names_of, numbers_of


def memory_in(cache: str | None) -> Any:
    from derender.evaluation import memory

    return memory.memory_in(cache)


def model_facts(model: Any) -> dict[str, Any]:
    from derender.features import model_fingerprint

    return {"weights": model_fingerprint(model), "model": model.settings.model_dump(mode="json")}


def chosen_labels(
    rows: Any, label: Sequence[str] | None, attributes: bool, least: int = 1
) -> tuple[str, ...]:
    from derender.evaluation.feature_rows import chosen_labels as choose

    names, notes = choose(rows[0].tables[0], label, attributes, least)
    for note in notes:
        notice(note)
    return names


def aligned(pictures: Any, files: Sequence[str]) -> Any:
    from derender.evaluation.feature_rows import aligned as align

    return align(pictures, files)


def embedded(model: Any, pictures: Any, memory: Any, what: str) -> Any:
    from derender.evaluation.feature_rows import embedded_table

    with progress_bar(what) as report:
        return embedded_table(model, pictures, memory, report)


def control_rows(
    pictures: Any, settings: Any, factors: Any, seeds: Any, device: str, memory: Any, fit_on: Any = None
) -> Any:
    from derender.evaluation import controls

    with progress_bar("embedding controls") as report:
        return controls.control_rows(
            pictures, settings, factors, seeds, device=device, memory=memory, fit_on=fit_on, progress=report
        )


class Pictures:
    def __init__(self, data: str | Path, dataset: str, limit: int | None = None):
        self.data, self.dataset, self.limit = data, dataset, limit

    def at(self, image_size: int) -> Any:
        from derender.inputs import as_images

        with progress_bar("reading") as report:
            found = as_images(self.data, image_size, dataset=self.dataset, limit=self.limit, progress=report)
        report_images(found)
        return found
