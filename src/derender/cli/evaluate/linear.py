"""`derender evaluate linear`: what does a linear head read from features, given few labels?"""

from typing import Annotated

import typer

from derender.cli import feature_rows, scoring
from derender.cli.console import progress_bar
from derender.cli.gathered import gathered

Counts = Annotated[
    str, typer.Option("--counts", help="Numbers of labelled rows to learn from, with commas between.")
]
Heads = Annotated[
    str,
    typer.Option(
        "--heads",
        help="Probes: linear (the paper's), centred (the same on features of mean 0), logistic, k-NN.",
    ),
]
Seeds = Annotated[int, typer.Option("--seeds", min=1, metavar="N", help="Draws of training rows.")]
TestFraction = Annotated[
    float, typer.Option("--test-fraction", min=0.01, max=0.99, help="Share of the rows that is tested.")
]
Groups = Annotated[
    str | None,
    typer.Option("--groups", help="Label whose rows stay on one side of the split, as identity."),
]
Finetune = Annotated[
    bool, typer.Option("--finetune", help="Also train the encoders with the head (slow without a GPU).")
]
Epochs = Annotated[int, typer.Option("--epochs", min=1, metavar="N", help="Of the paper's head.")]


def register(group: typer.Typer) -> None:
    group.command(
        "linear",
        epilog="Example: derender evaluate linear --model runs/faces --data celeba.zip --attributes",
    )(linear)


@gathered
def linear(
    asked: scoring.Asked,
    computed: scoring.Computed,
    published: scoring.Published,
    counts: Counts = "100,500,1000",
    heads: Heads = "linear,logistic,k-NN",
    seeds: Seeds = 5,
    test_fraction: TestFraction = 0.5,
    groups: Groups = None,
    finetune: Finetune = False,
    epochs: Epochs = 100,
    untrained_seeds: feature_rows.UntrainedSeeds = 5,
) -> None:
    """What does a linear head read from features, given 100, 500 or 1,000 labels? 1 is best."""
    from derender.evaluation.linear_probes import check_head

    source = computed.source(asked)
    published.check()
    if finetune and asked.model is None:
        raise ValueError("--finetune trains the encoders: give --model M with --data D")
    chosen = tuple(name.strip() for name in heads.split(","))
    for head in chosen:
        check_head(head)
    rows = source.rows(asked.factors, computed.from_seed(untrained_seeds))
    names = feature_rows.chosen_labels(rows, asked.label, asked.attributes, least=2)

    from derender.cli.finetuned import all_finetuned
    from derender.cli.models import open_model
    from derender.evaluation.feature_rows import prepare
    from derender.evaluation.linear_compare import compare_linear
    from derender.evaluation.linear_head import HeadSettings
    from derender.evaluation.linear_task import choose_rows, task_of
    from derender.report.tables_comparison import linear_tables

    ready = prepare(
        rows,
        names,
        min_count=asked.min_count,
        max_count=asked.max_count,
        keep=[groups] if groups else (),
    )
    task = task_of(ready.labels)
    draws = tuple(computed.from_seed(seeds))
    wanted = feature_rows.whole_numbers(counts, "--counts")
    split = choose_rows(
        task,
        ready.files,
        wanted,
        draws,
        test_fraction=test_fraction,
        partition=ready.partition,
        groups=ready.kept[groups] if groups else None,
    )
    settings = HeadSettings(epochs=epochs)
    tuned = None
    if finetune:
        assert asked.model is not None
        tuned = all_finetuned(
            {source.row_name(asked.factors): [open_model(asked.model, source.device)]},
            lambda size: source.pictures_of(size, ready.files).images,
            ready, task, split, draws, feature_rows.factors_of(asked.factors), settings, source.memory,
        )  # fmt: skip
    with progress_bar("probing", "probes") as report:
        found = compare_linear(
            ready.features,
            task,
            split,
            draws,
            controls=ready.controls,
            heads=chosen,
            finetuned=tuned,
            settings=settings,
            resample_count=computed.resamples,
            memory=source.memory,
            progress=report,
        )
    values = {**found.numbers(), "labels": names}
    published.show(linear_tables(found), values, [scoring.remembered(source.memory)])
