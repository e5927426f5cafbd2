"""`derender evaluate linear`: what does a linear head read from features, given few labels?"""

from typing import Annotated

import typer

from derender.cli import feature_rows, options
from derender.cli.console import bar, say, show_scores, write_json

Counts = Annotated[
    str, typer.Option("--counts", help="Numbers of labelled rows to learn from, with commas between.")
]
Heads = Annotated[str, typer.Option("--heads", help="Probes: linear (the paper's), logistic, k-NN.")]
Seeds = Annotated[int, typer.Option("--seeds", min=1, metavar="N", help="Draws of training rows.")]
TestFraction = Annotated[
    float, typer.Option("--test-fraction", min=0.01, max=0.99, help="Share of the rows that is tested.")
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


def linear(
    label: Annotated[
        list[str] | None,
        typer.Option("--label", "-l", help="Label column; several if each has two values."),
    ] = None,
    attributes: Annotated[bool, typer.Option("--attributes", help="Ask every yes/no label.")] = False,
    features: feature_rows.Features = None,
    model: Annotated[str | None, typer.Option("--model", "-m", help="Or a model, with --data.")] = None,
    data: feature_rows.ControlData = None,
    dataset: options.Dataset = "auto",
    limit: options.Limit = None,
    factors: feature_rows.Factors = "geometry,albedo",
    counts: Counts = "100,500,1000",
    heads: Heads = "linear,logistic,k-NN",
    seeds: Seeds = 5,
    test_fraction: TestFraction = 0.5,
    groups: Annotated[
        str | None,
        typer.Option("--groups", help="Label whose rows stay on one side of the split, as identity."),
    ] = None,
    min_count: feature_rows.MinCount = 1,
    max_count: feature_rows.MaxCount = None,
    finetune: Finetune = False,
    epochs: Epochs = 100,
    untrained_seeds: feature_rows.UntrainedSeeds = 5,
    resamples: feature_rows.Resamples = 1_000,
    seed: options.Seed = 0,
    device: options.Device = "auto",
    cache: feature_rows.Cache = None,
    json_file: options.Json = None,
    markdown: feature_rows.Markdown = None,
    latex: feature_rows.Latex = None,
    force: options.Force = False,
) -> None:
    """What does a linear head read from features, given 100, 500 or 1,000 labels? 1 is best."""
    source = feature_rows.Source(features, model, data, dataset, limit, device, cache)
    feature_rows.refuse_to_replace(force, markdown, latex)
    if finetune and model is None:
        raise ValueError("--finetune trains the encoders: give --model M with --data D")
    rows = source.rows(factors, range(seed, seed + untrained_seeds))
    names = feature_rows.chosen_labels(rows, label, attributes)

    from derender.cli.finetuned import finetuned_answers
    from derender.evaluation.feature_rows import prepare
    from derender.evaluation.linear_compare import compare_linear
    from derender.evaluation.linear_head import HeadSettings
    from derender.evaluation.linear_task import choose_rows, task_of
    from derender.report.tables_comparison import LINEAR_COLUMNS, linear_part_table, verdict_table

    ready = prepare(rows, names, min_count=min_count, max_count=max_count, keep=[groups] if groups else ())
    task = task_of(ready.labels)
    draws = tuple(range(seed, seed + seeds))
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
        tuned = finetuned_answers(source, ready.files, task, split, draws, factors, settings)
    with bar("probing", "probes") as report:
        found = compare_linear(
            ready.features,
            task,
            split,
            draws,
            controls=ready.controls,
            heads=tuple(name.strip() for name in heads.split(",")),
            finetuned=tuned,
            settings=settings,
            resample_count=resamples,
            memory=source.memory,
            progress=report,
        )
    tables = []
    for part in found.parts:
        tables.append(linear_part_table(found, part))
        caption = f"{part.count:,} labelled rows, {part.head}: above the strongest control?"
        tables.append(verdict_table(part.rows, LINEAR_COLUMNS, caption))
    for table in tables:
        show_scores(table, json_file)
    say(source.remembered())
    write_json(json_file, {**found.numbers(), "labels": names})
    feature_rows.write_tables(tables, markdown, latex)
