"""`derender evaluate`: one protocol a command, each beside its controls."""

from typing import Annotated

import typer

from derender.cli import options
from derender.cli.console import bar, say, show_scores, write_json


def register(app: typer.Typer) -> None:
    group = typer.Typer(help="Score features or a model, beside controls.", no_args_is_help=True)
    group.command(
        "cluster",
        epilog="Example: derender evaluate cluster --model runs/faces --data lfw.zip --label identity",
    )(cluster)
    group.command(
        "geometry", epilog="Example: derender evaluate geometry --model runs/faces --data made/::test_gt"
    )(geometry)
    group.command(
        "reconstruction",
        epilog="Example: derender evaluate reconstruction --model runs/faces --data photos/ --part test",
    )(reconstruction)
    app.add_typer(group, name="evaluate")


def cluster(
    label: Annotated[str, typer.Option("--label", "-l", help="Label column that gives the classes.")],
    features: Annotated[
        str | None,
        typer.Option("--features", "-f", help="A table made by derender embed.", metavar="FILE.parquet"),
    ] = None,
    model: Annotated[str | None, typer.Option("--model", "-m", help="Or a model, with --data.")] = None,
    data: Annotated[
        str | None, typer.Option("--data", "-d", help="Pictures; they also give the controls pixels and PCA.")
    ] = None,
    dataset: options.Dataset = "auto",
    factors: Annotated[
        str, typer.Option("--factors", help="Features to cluster by, with commas between, or all.")
    ] = "geometry,albedo",
    mean_by: Annotated[
        list[str] | None,
        typer.Option("--mean-by", help="Average first over rows that share this label; may be repeated."),
    ] = None,
    min_count: Annotated[
        int, typer.Option("--min-count", min=1, metavar="N", help="Leave out classes with fewer rows.")
    ] = 1,
    max_count: Annotated[
        int | None, typer.Option("--max-count", min=1, metavar="N", help="At most so many rows of a class.")
    ] = None,
    clusters: Annotated[
        int | None, typer.Option("--clusters", min=1, metavar="N", help="By default one for each class.")
    ] = None,
    seed: options.Seed = 0,
    device: options.Device = "auto",
    json_file: options.Json = None,
) -> None:
    """Do features group pictures by a label that training never saw? Ward clustering; 1 is best."""
    if (features is None) == (model is None):
        raise ValueError("give either --features FILE, or --model M with --data D")
    if model is not None and data is None:
        raise ValueError("--model needs --data: the pictures to embed")
    from derender.features import FeatureTable, embed_pictures

    tables: dict[str, FeatureTable] = {}
    wanted = None if factors == "all" else tuple(name.strip() for name in factors.split(","))
    if features is not None:
        tables[factors.replace(",", " + ")] = FeatureTable.read(features)
        if data is not None:
            raise ValueError("--data goes with --model; for a table made before, leave it out")
    else:
        from derender.baselines.controls import pca_features, pixel_features, untrained_features
        from derender.cli.models import open_model
        from derender.data import read_pictures

        assert model is not None and data is not None
        net = open_model(model, device)
        with bar("reading") as report:
            pictures = read_pictures(data, net.image_size, dataset=dataset, progress=report)
        pictures.label(label)
        say(pictures.describe())
        with bar("embedding") as report:
            tables[factors.replace(",", " + ")] = embed_pictures(net, pictures, progress=report)
        with bar("untrained control") as report:
            tables["untrained encoder"] = untrained_features(net, pictures, seed=seed, progress=report)
        components = max(1, min(64, len(pictures) // 4))  # whitening needs many more rows than components
        tables[f"PCA ({components})"] = pca_features(pictures, components=components, seed=seed)
        tables["pixels"] = pixel_features(pictures)

    from derender.evaluation import cluster_table
    from derender.report.score_table import clustering_table

    results, learned = {}, (next(iter(tables)), "untrained encoder")
    for name, table in tables.items():
        results[name] = cluster_table(
            table,
            label,
            factors=wanted if name in learned else None,
            mean_by=tuple(mean_by or ()),
            min_count=min_count,
            max_count=max_count,
            n_clusters=clusters,
        )
    ours, *controls = results
    scores = clustering_table(results, controls)
    show_scores(scores, json_file)
    say(f"{ours} is {scores.verdict(0)}")
    write_json(json_file, {"label": label, "results": results, "chance_of": ours})


def geometry(
    model: options.Model,
    data: options.Data,
    limit: options.Limit = None,
    batch_size: options.BatchSize = 64,
    seed: options.Seed = 0,
    device: options.Device = "auto",
    json_file: options.Json = None,
) -> None:
    """Is the geometry the true one? SIDE and MAD on rendered pictures with exact depth, beside controls."""
    from derender.baselines.controls import untrained_twin
    from derender.cli.models import open_model
    from derender.data import read_ground_truth
    from derender.evaluation import evaluate_factors, evaluate_geometry
    from derender.report.score_table import factor_table, geometry_table

    net = open_model(model, device)
    truth = read_ground_truth(data, limit=limit)
    with bar("decomposing") as report:
        found = evaluate_geometry(
            net, truth, batch_size=batch_size, untrained=untrained_twin(net, seed), progress=report
        )
    scores = geometry_table(found, len(truth))
    show_scores(scores, json_file)
    values = {"pictures": len(truth), "geometry": found}
    if truth.albedo is not None:
        factors = evaluate_factors(net, truth, batch_size=batch_size)
        show_scores(factor_table(factors, len(truth)), json_file)
        values["factors"] = factors
    say(f"depth is {scores.verdict(0)}")
    say(f"normals are {scores.verdict(1)}")
    write_json(json_file, values)


def reconstruction(
    model: options.Model,
    data: options.Data,
    dataset: options.Dataset = "auto",
    part: options.Part = "all",
    limit: options.Limit = None,
    batch_size: options.BatchSize = 64,
    device: options.Device = "auto",
    json_file: options.Json = None,
) -> None:
    """How well are pictures rendered again? L1 and PSNR inside the mask, beside the mean picture."""
    from derender.cli.models import open_model, part_of
    from derender.data import read_pictures
    from derender.evaluation import evaluate_reconstruction, mean_picture
    from derender.report.score_table import reconstruction_table

    net = open_model(model, device)
    with bar("reading") as report:
        pictures = read_pictures(data, net.image_size, dataset=dataset, limit=limit, progress=report)
    chosen = part_of(pictures, part, model)
    mean = mean_picture((pictures if part == "all" else part_of(pictures, "train", model)).images)
    with bar("rendering") as report:
        found = evaluate_reconstruction(net, chosen.images, mean=mean, batch_size=batch_size, progress=report)
    scores = reconstruction_table(found, len(chosen))
    show_scores(scores, json_file)
    say(f"the model is {scores.verdict(0)}")
    write_json(json_file, {"pictures": len(chosen), "part": part, "reconstruction": found})
