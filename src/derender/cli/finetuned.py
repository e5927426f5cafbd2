"""Fine-tuned answers for a table: a model and its untrained twins trained through, each remembered."""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from derender.cli.console import bar

if TYPE_CHECKING:
    import numpy as np

    from derender.cli.feature_rows import Source
    from derender.evaluation.linear_head import HeadSettings
    from derender.evaluation.linear_task import Rows, Task


def finetuned_answers(
    source: "Source",
    files: Sequence[str],
    task: "Task",
    split: "Rows",
    seeds: Sequence[int],
    factors: str,
    settings: "HeadSettings",
) -> "dict[str, dict[int, np.ndarray]]":
    """By row name and number of labels, (S, T, A) answers: the model, then untrained ones of its kind."""
    import numpy as np

    from derender.cli.feature_rows import factors_of
    from derender.cli.models import open_model
    from derender.evaluation.linear_finetune import finetune
    from derender.features import model_fingerprint
    from derender.model import Derenderer

    assert source.model is not None
    net = open_model(source.model, source.device)
    images = source.pictures_of(net.image_size, files).images
    chosen = factors_of(factors) or tuple(factor.name for factor in net.factors)

    def answers(model: Any, count: int, at: int, what: str) -> "np.ndarray":
        rows = split.train[count][at]
        inputs = {
            "weights": model_fingerprint(model), "images": images, "targets": task.targets, "kind": task.kind,
            "rows": rows, "tested": split.test, "seed": seeds[at], "factors": list(chosen),
            "settings": settings.model_dump(),
        }  # fmt: skip

        def make() -> "dict[str, np.ndarray]":
            with bar(f"fine-tuning {what}, {count:,} labels, seed {seeds[at]}", "epochs") as report:
                found = finetune(
                    model, images, task, rows, split.test,
                    factors=chosen, seed=seeds[at], settings=settings, progress=report,
                )  # fmt: skip
            return {"probabilities": found}

        return source.memory.recall("finetuned", inputs, make)["probabilities"]

    def untrained(at: int) -> Any:
        return Derenderer.seeded(net.settings, seeds[at], factors=net.factors).to(net.device).eval()

    name = source.row_name(factors)
    found: dict[str, dict[int, np.ndarray]] = {name: {}, "untrained encoder": {}}
    for count in split.train:
        seeded = range(len(seeds))
        found[name][count] = np.stack([answers(net, count, at, name) for at in seeded])
        found["untrained encoder"][count] = np.stack(
            [answers(untrained(at), count, at, "an untrained encoder") for at in seeded]
        )
    return found
