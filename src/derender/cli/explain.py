"""`derender explain`: which factor made an answer, and where in the picture it was seen."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from derender.cli import options, scoring
from derender.cli.console import progress_bar, refuse_existing, report_images, result
from derender.cli.gathered import gathered

if TYPE_CHECKING:
    from derender.data import PictureSet
    from derender.evaluation.linear_task import Rows, Task
    from derender.features import FeatureTable
    from derender.interpretation import ClusterShares, Explanation
    from derender.interpretation.sanity import Similarity
    from derender.model import Derenderer
    from derender.report.explanation import Pair

LEARNED_SHARE, LEARNED_MOST = 0.4, 500


def register(app: typer.Typer) -> None:
    app.command(
        "explain",
        epilog="Example: derender explain --model runs/faces --data celeba.zip --attributes --out why/",
    )(explain)


@gathered
def explain(
    model: options.Model,
    data: options.Data,
    published: scoring.Published,
    label: Annotated[
        list[str] | None,
        typer.Option("--label", "-l", help="Label column; several if each has two values."),
    ] = None,
    attributes: Annotated[bool, typer.Option("--attributes", help="Every yes/no label.")] = False,
    bins: Annotated[
        int | None,
        typer.Option("--bins", min=2, metavar="N", help="Cut a column of numbers into so many classes."),
    ] = None,
    min_count: Annotated[
        int, typer.Option("--min-count", min=2, metavar="N", help="Leave out classes of fewer pictures.")
    ] = 2,
    out: Annotated[
        Path | None,
        typer.Option("--out", "-o", help="Folder for page, chart, sheets of maps and probe.", metavar="DIR"),
    ] = None,
    dataset: options.Dataset = "auto",
    limit: options.Limit = None,
    part: options.Part = "all",
    seeds: Annotated[int, typer.Option("--seeds", min=1, metavar="N", help="Probes to average over.")] = 3,
    count: Annotated[
        int | None,
        typer.Option(
            "--count", min=2, metavar="N", help="Pictures to learn from; by default 2 of 5, at most 500."
        ),
    ] = None,
    groups: Annotated[
        str | None,
        typer.Option("--groups", help="Label whose rows stay on one side of the split, as identity."),
    ] = None,
    head: Annotated[str, typer.Option("--head", help="logistic, or linear: the paper's head.")] = "logistic",
    output: Annotated[
        str, typer.Option("--output", help="What is attributed: logit or probability.")
    ] = "logit",
    baseline: Annotated[
        str, typer.Option("--baseline", help="Where the path starts: zero (the paper's) or mean.")
    ] = "zero",
    sheets: Annotated[
        int, typer.Option("--sheets", min=0, metavar="N", help="Labels to draw maps for, best told first.")
    ] = 3,
    rows: Annotated[int, typer.Option("--rows", min=2, metavar="N", help="Pictures on a sheet.")] = 6,
    clusters: Annotated[
        int | None,
        typer.Option("--clusters", min=2, metavar="N", help="Also: what sets so many clusters apart?"),
    ] = None,
    pair: Annotated[
        tuple[str, str] | None,
        typer.Option(
            "--pair", help="Also: what makes these two pictures of the data alike?", metavar="FILE FILE"
        ),
    ] = None,
    batch_size: options.BatchSize = 256,
    seed: options.Seed = 0,
    device: options.Device = "auto",
) -> None:
    """Which factor made the answer, and where was it seen? Shares, maps, and controls for both."""
    if out is not None:
        refuse_existing(out, published.force)
    if bool(label) == attributes:
        raise ValueError("give either --label NAME (may be repeated) or --attributes")
    published.check()
    from derender.cli.models import open_model, part_of
    from derender.data import read_pictures
    from derender.evaluation.feature_rows import attribute_columns
    from derender.features import embed_pictures
    from derender.interpretation import explain_labels, question
    from derender.interpretation.shares import captum_attr
    from derender.report import tables_explanation as tables

    captum_attr()
    net = open_model(model, device)
    with progress_bar("reading") as report:
        pictures = read_pictures(data, net.image_size, dataset=dataset, limit=limit, progress=report)
    pictures = part_of(pictures, part, model)
    report_images(pictures)
    both = None if pair is None else tuple(_row_of(pictures, name) for name in pair)
    with progress_bar("embedding") as report:
        table = embed_pictures(net, pictures, batch_size=batch_size, progress=report)
    names = attribute_columns(table) if attributes else tuple(dict.fromkeys(label or ()))
    if not names:
        raise ValueError(f"there is no yes/no label; there is {', '.join(table.labels) or 'no label'}")
    task = question(table.labels, names, bins=bins, min_count=min_count, source=data)
    draws = range(seed, seed + seeds)
    split = _split(task, table, count, draws, groups)
    untrained = _untrained(net, pictures, draws, batch_size)
    with progress_bar("probing", "probes") as report:
        found = explain_labels(
            table.factors, task, split,
            untrained=untrained, seeds=draws, head=head, output=output, baseline=baseline, progress=report,
        )  # fmt: skip
    apart = None if clusters is None else _clusters(table, clusters, seed)
    alike = None if both is None or pair is None else _pair(table, pictures, both, pair, seed)
    checks: list[Similarity] = []
    if out is not None:
        checks = _write(out, net, model, pictures, task, split, found, sheets, rows, seeds, apart, alike)
    shown = [
        tables.share_table(found),
        tables.drop_table(found),
        *([tables.sanity_table(checks)] if checks else []),
        *([] if apart is None else [tables.cluster_share_table(apart)]),
        *([] if alike is None else [tables.pair_table(alike.parts, alike.names)]),
    ]
    notes = [
        *tables.share_verdicts(found),
        *(f"not to be trusted, fresh weights give the same map: {name}" for name in tables.untrusted(checks)),
    ]
    if out is None:
        notes.append("add --out DIR for the page, the chart and maps over pictures")
    else:
        result(f"report {out / 'explain.html'}", published.json_file)
    values = {**found.numbers(), "source": data, "sanity": checks, "clusters": apart, "out": out}
    published.show(shown, {**values, "pair": None if alike is None else alike.parts}, notes)


def _row_of(pictures: "PictureSet", name: str) -> int:
    from derender.data import suggestion

    if name not in pictures.files:
        raise ValueError(f"{pictures.source} has no picture {name!r}{suggestion(name, pictures.files)}")
    return pictures.files.index(name)


def _split(
    task: "Task", table: "FeatureTable", count: int | None, draws: range, groups: str | None
) -> "Rows":
    """Half of the pictures is tested; each seed learns from its own draw of the others."""
    from derender.evaluation.linear_task import choose_rows

    wanted = count or max(2, min(LEARNED_MOST, int(LEARNED_SHARE * task.known.sum())))
    sides = table.label(groups) if groups else None
    return choose_rows(
        task, table.files, (wanted,), draws, partition=_owners_split(task, table), groups=sides
    )


def _owners_split(task: "Task", table: "FeatureTable") -> Any:
    """The split of the data's owners, unless all that carries a label here is their test part."""
    partition = table.labels.get("partition")
    if partition is None or (partition[task.known] == "test").all():
        return None
    return partition


def _untrained(net: "Derenderer", pictures: "PictureSet", draws: range, batch_size: int) -> list[Any]:
    from derender.baselines.controls import untrained_features

    found = []
    for seed in draws:
        with progress_bar(f"untrained encoder {seed}") as report:
            twin = untrained_features(net, pictures, seed=seed, batch_size=batch_size, progress=report)
        found.append(twin.factors)
    return found


def _clusters(table: "FeatureTable", count: int, seed: int) -> "ClusterShares":
    from derender.evaluation.clustering_methods import clusterings
    from derender.interpretation import cluster_shares

    made = clusterings(table.concatenate(), [count], seed=seed)[count]
    return cluster_shares(table.factors, made, seed=seed)


def _pair(
    table: "FeatureTable", pictures: "PictureSet", both: tuple[int, ...], names: tuple[str, str], seed: int
) -> "Pair":
    from derender.interpretation import pair_parts
    from derender.report.explanation import Pair

    return Pair(pair_parts(table.factors, both[0], both[1], seed=seed), names, pictures.images[list(both)])


def _write(
    out: Path, net: "Derenderer", model: str, pictures: "PictureSet", task: "Task", split: "Rows",
    found: "Explanation", sheets: int, rows: int, seeds: int,
    apart: "ClusterShares | None", alike: "Pair | None",
) -> "list[Similarity]":  # fmt: skip
    """The folder, whole or not at all; gives how the maps stood their test."""
    from derender.report.explanation import Shown, explanation_page
    from derender.report.saliency import draw_maps, safe_name
    from derender.report.share_chart import share_chart
    from derender.storage.atomic import atomic_folder

    with progress_bar("drawing maps", "labels") as report:
        drawn, checks = draw_maps(
            net, found, pictures.images, task.targets, split.test, labels=sheets, rows=rows, seeds=seeds,
            progress=report,
        )  # fmt: skip
    svg, png = share_chart(found)
    shown = Shown(found, svg, pictures.source, model, drawn, checks, apart, alike)
    with atomic_folder(out) as folder:
        (folder / "shares.svg").write_text(svg, encoding="utf-8")
        (folder / "shares.png").write_bytes(png)
        for place, (name, made) in enumerate(drawn.items(), 1):
            for method, sheet in made.items():
                sheet.save(folder / f"maps-{place}-{safe_name(name)}-{safe_name(method)}.png")
        found.probe.save(folder / "probe")
        explanation_page(shown).write(folder / "explain.html")
    return checks
