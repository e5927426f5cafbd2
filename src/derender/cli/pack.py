"""`derender pack`: a model in fewer bytes, to give away."""

from typing import Annotated

import typer

from derender.cli import options
from derender.cli.console import notice, progress_bar, refuse_existing, result, write_json

Maps = Annotated[
    str,
    typer.Option(
        "--maps",
        help="How the large maps of features and fitting are kept: bytes or float16.",
        metavar="KIND",
    ),
]
Pictures = Annotated[
    str | None,
    typer.Option("--data", "-d", help="Pictures by which to say what packing costs.", metavar="PATH"),
]


def register(app: typer.Typer) -> None:
    app.command("pack", epilog="Example: derender pack --model runs/mine --out mine --data photos/")(pack)


def pack(
    model: options.Model,
    out: options.OutModel,
    maps: Maps = "bytes",
    data: Pictures = None,
    dataset: options.Dataset = "auto",
    part: options.Part = "all",
    limit: options.Limit = None,
    device: options.Device = "auto",
    force: options.Force = False,
    json_file: options.Json = None,
) -> None:
    """Write a copy of a model in fewer bytes: weights in float16, large maps in bytes or float16.

    Card, held-out errors and split go along. With --data it is said how far features and renderings move.
    """
    from derender.cli.models import keep_split, open_model, pictures_for
    from derender.evaluation.copies import copy_cost
    from derender.storage.packing import pack_model

    refuse_existing(out, force)
    net = open_model(model, device)
    chosen = None
    if data is not None:
        chosen = pictures_for(net, model, data, dataset=dataset, part=part, limit=limit, fewest=2)
    made = pack_model(model, out, maps=maps, overwrite=force)
    keep_split(made.folder, model)
    sizes = {"before": sum(made.before.values()), "after": sum(made.after.values())}
    notice(f"{sizes['after'] / 1e6:,.2f} MB, before {sizes['before'] / 1e6:,.2f} MB")
    facts = {"model": made.folder, "bytes": sizes}
    if chosen is not None:
        with progress_bar("comparing") as report:
            cost = copy_cost(net, open_model(str(made.folder), device), chosen.images, progress=report)
        moved = ", ".join(f"{name} {share:.2%}" for name, share in cost.moved.items())
        notice(f"features moved, in shares of how far two pictures are apart: {moved}")
        notice(f"rendered again with L1 {cost.l1:.5f}, before {cost.l1_before:.5f}")
        facts |= {"pictures": len(chosen), "cost": cost}
    result(f"model {made.folder}", json_file)
    write_json(json_file, facts)
