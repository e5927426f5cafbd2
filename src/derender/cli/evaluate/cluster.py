"""`derender evaluate cluster`: do features group pictures by a label that training never saw?"""

from typing import Annotated, Literal

import typer

from derender.cli import feature_rows, options
from derender.cli.console import say, show_scores, write_json

Method = Literal["ward", "finch", "k-means"]


def register(group: typer.Typer) -> None:
    group.command(
        "cluster",
        epilog="Example: derender evaluate cluster --model runs/faces --data lfw.zip --label identity",
    )(cluster)


def cluster(
    label: Annotated[
        list[str] | None,
        typer.Option("--label", "-l", help="Label column that gives the classes; repeat for the mean."),
    ] = None,
    attributes: Annotated[
        bool, typer.Option("--attributes", help="Score the mean over every yes/no label.")
    ] = False,
    features: feature_rows.Features = None,
    model: Annotated[str | None, typer.Option("--model", "-m", help="Or a model, with --data.")] = None,
    data: feature_rows.ControlData = None,
    dataset: options.Dataset = "auto",
    limit: options.Limit = None,
    factors: feature_rows.Factors = "geometry,albedo",
    method: Annotated[Method, typer.Option("--method", help="How to cluster.")] = "ward",
    mean_by: feature_rows.MeanBy = None,
    min_count: feature_rows.MinCount = 1,
    max_count: feature_rows.MaxCount = None,
    clusters: Annotated[
        int | None, typer.Option("--clusters", min=1, metavar="N", help="By default one for each class.")
    ] = None,
    untrained_seeds: feature_rows.UntrainedSeeds = 3,
    resamples: feature_rows.Resamples = 1_000,
    seed: options.Seed = 0,
    device: options.Device = "auto",
    cache: feature_rows.Cache = None,
    json_file: options.Json = None,
    markdown: feature_rows.Markdown = None,
    latex: feature_rows.Latex = None,
    force: options.Force = False,
) -> None:
    """Do features group pictures by a label that training never saw? 1 is best."""
    source = feature_rows.Source(features, model, data, dataset, limit, device, cache)
    feature_rows.refuse_to_replace(force, markdown, latex)
    rows = source.rows(factors, range(seed, seed + untrained_seeds))
    names = feature_rows.chosen_labels(rows, label, attributes)

    from derender.evaluation.clustering_compare import compare_clusterings
    from derender.evaluation.clustering_levels import finch_levels
    from derender.evaluation.feature_rows import prepare
    from derender.report.tables_comparison import (
        CLUSTER_COLUMNS,
        cluster_comparison_table,
        finch_table,
        verdict,
        verdict_table,
    )

    ready = prepare(rows, names, mean_by=mean_by or (), min_count=min_count, max_count=max_count)
    found = compare_clusterings(
        ready.features,
        ready.labels,
        controls=ready.controls,
        method=method,
        n_clusters=clusters,
        resample_count=resamples,
        seed=seed,
        memory=source.memory,
    )
    caption = "Above the strongest control? (paired resamples of the rows)"
    tables = [cluster_comparison_table(found), verdict_table(found.rows, CLUSTER_COLUMNS, caption)]
    levels = {}
    if method == "finch" and len(names) == 1:
        for row in rows:
            levels[row.name] = finch_levels(
                ready.features[row.name][0], ready.labels[names[0]], source.memory
            )
        tables.append(finch_table(rows[0].name, levels[rows[0].name], found.labels[names[0]]))
    for table in tables:
        show_scores(table, json_file)
    say(verdict(found.rows[0], "accuracy"))
    if ready.n_dropped:
        say(f"{ready.n_dropped:,} rows without a label of {', '.join(names)} or {', '.join(mean_by or ())}")
    say(source.remembered())
    write_json(json_file, {**found.numbers(), "n_dropped_before": ready.n_dropped, "finch": levels})
    feature_rows.write_tables(tables, markdown, latex)
