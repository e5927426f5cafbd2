"""Fine-tuned answers for a table: models and their untrained twins trained through, each remembered.

Controls without an encoder (pixels, principal components) have nothing below the head to train: theirs are
the answers of the head alone.
"""

import functools
from collections.abc import Callable, Collection, Mapping, Sequence
from typing import TYPE_CHECKING, Any

from derender.cli.console import progress_bar

if TYPE_CHECKING:
    import numpy as np

    from derender.evaluation.linear_head import HeadSettings
    from derender.evaluation.linear_task import Rows, Task
    from derender.evaluation.memory import Memory
    from derender.model import Derenderer

UNTRAINED = "untrained encoder"


def finetuned_answers(
    models: "Mapping[str, Sequence[Derenderer]]",
    images_of: "Callable[[int], np.ndarray]",
    task: "Task",
    split: "Rows",
    seeds: Sequence[int],
    factors: Sequence[str] | None,
    settings: "HeadSettings",
    memory: "Memory",
) -> "dict[str, dict[int, np.ndarray]]":
    """By row name and number of labels, (S, T, A) answers: models, then untrained ones of the first's kind.

    Args:
        models: by row name, one for each run; seed s trains run s modulo their number.
        images_of: the pictures of the task's rows at a size in pixels, (N, 3, H, W) uint8.
        task, split, seeds: what is asked, who learns and is tested in each draw.
        factors: whose encoders are trained; None means all.
        settings: of the paper's head.
        memory: where answers are kept.
    """
    import numpy as np

    from derender.evaluation.linear_finetune import finetune
    from derender.features import model_fingerprint
    from derender.model import Derenderer

    images_of = functools.cache(images_of)

    def answers(model: "Derenderer", count: int, at: int, what: str) -> "np.ndarray":
        rows, images = split.train[count][at], images_of(model.image_size)
        chosen = list(factors or (factor.name for factor in model.factors))
        inputs = {
            "weights": model_fingerprint(model), "images": images, "targets": task.targets, "kind": task.kind,
            "rows": rows, "tested": split.test, "seed": seeds[at], "factors": chosen,
            "settings": settings.model_dump(),
        }  # fmt: skip

        def make() -> "dict[str, np.ndarray]":
            with progress_bar(f"fine-tuning {what}, {count:,} labels, seed {seeds[at]}", "epochs") as report:
                found = finetune(
                    model, images, task, rows, split.test,
                    factors=chosen, seed=seeds[at], settings=settings, progress=report,
                )  # fmt: skip
            return {"probabilities": found}

        return memory.recall("finetuned", inputs, make)["probabilities"]

    first = next(iter(models.values()))[0]

    def untrained(at: int) -> "Derenderer":
        fresh = Derenderer.seeded(first.settings, seeds[at], factors=first.factors)
        return fresh.to(first.device).eval()

    found: dict[str, dict[int, np.ndarray]] = {name: {} for name in (*models, UNTRAINED)}
    for count in split.train:
        seeded = range(len(seeds))
        for name, runs in models.items():
            found[name][count] = np.stack([answers(runs[at % len(runs)], count, at, name) for at in seeded])
        found[UNTRAINED][count] = np.stack(
            [answers(untrained(at), count, at, f"an {UNTRAINED}") for at in seeded]
        )
    return found


def answers_of_the_head(
    features: "Mapping[str, Sequence[np.ndarray]]",
    controls: Collection[str],
    task: "Task",
    split: "Rows",
    seeds: Sequence[int],
    settings: "HeadSettings",
    memory: "Memory",
) -> "dict[str, dict[int, np.ndarray]]":
    """The same of the controls that have no encoder."""
    from derender.evaluation.linear_compare import probe_runs

    return {
        name: {
            count: probe_runs("linear", features[name], task, rows, split.test, seeds, settings, memory)
            for count, rows in split.train.items()
        }
        for name in controls
        if not name.startswith(UNTRAINED)
    }


def all_finetuned(
    models: "Mapping[str, Sequence[Derenderer]]", images_of: "Callable[[int], np.ndarray]", ready: Any,
    task: "Task", split: "Rows", seeds: Sequence[int], factors: Sequence[str] | None,
    settings: "HeadSettings", memory: "Memory",
) -> "dict[str, dict[int, np.ndarray]]":  # fmt: skip
    """Models, untrained ones, and the controls among the rows ``ready`` that have no encoder."""
    how = (task, split, seeds)
    return {
        **finetuned_answers(models, images_of, *how, factors, settings, memory),
        **answers_of_the_head(ready.features, ready.controls, *how, settings, memory),
    }
