"""`derender evaluate cluster`: do features group pictures by a label that training never saw?"""

from typing import Annotated

import typer

from derender.cli import feature_rows, scoring
from derender.cli.gathered import gathered


def register(group: typer.Typer) -> None:
    group.command(
        "cluster",
        epilog="Example: derender evaluate cluster --model runs/faces --data lfw.zip --label identity",
    )(cluster)


@gathered
def cluster(
    asked: scoring.Asked,
    computed: scoring.Computed,
    published: scoring.Published,
    method: scoring.Method = "ward",
    mean_by: feature_rows.MeanBy = None,
    clusters: Annotated[
        int | None, typer.Option("--clusters", min=1, metavar="N", help="By default one for each class.")
    ] = None,
    untrained_seeds: feature_rows.UntrainedSeeds = 3,
) -> None:
    """Do features group pictures by a label that training never saw? 1 is best."""
    source = computed.source(asked)
    published.check()
    rows = source.rows(asked.factors, computed.from_seed(untrained_seeds))
    names = feature_rows.chosen_labels(rows, asked.label, asked.attributes)

    from derender.evaluation.clustering_compare import compare_clusterings
    from derender.evaluation.clustering_levels import finch_levels
    from derender.evaluation.clustering_methods import approximation
    from derender.evaluation.feature_rows import prepare
    from derender.evaluation.score_table import verdict, verdict_table
    from derender.report.tables_comparison import (
        CLUSTER_COLUMNS,
        cluster_comparison_table,
        finch_table,
    )

    ready = prepare(rows, names, mean_by=mean_by or (), min_count=asked.min_count, max_count=asked.max_count)
    found = compare_clusterings(
        ready.features,
        ready.labels,
        controls=ready.controls,
        method=method,
        n_clusters=clusters,
        resample_count=computed.resamples,
        seed=computed.seed,
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
            tables.append(finch_table(row.name, levels[row.name], found.labels[names[0]]))
    notes = [verdict(found.rows[0], "accuracy")]
    if approximate := approximation(method, found.n_rows):
        notes.append(approximate)
    if ready.n_dropped:
        by = ", ".join((*names, *(mean_by or ())))
        notes.append(f"{ready.n_dropped:,} rows without a label of {by} left out")
    more = {"approximation": approximate, "n_dropped_before": ready.n_dropped, "finch": levels}
    values = {**found.numbers(), **more}
    published.show(tables, values, [*notes, scoring.remembered(source.memory)])
