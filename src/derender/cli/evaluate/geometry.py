"""`derender evaluate geometry`: is the geometry the true one?"""

import typer

from derender.cli import options, scoring
from derender.cli.console import bar
from derender.cli.gathered import gathered


def register(group: typer.Typer) -> None:
    group.command(
        "geometry",
        epilog="Example: derender evaluate geometry --model runs/faces --data made/::test_gt",
    )(geometry)


@gathered
def geometry(
    model: options.Model,
    data: options.Data,
    published: scoring.Published,
    limit: options.Limit = None,
    batch_size: options.BatchSize = 64,
    seed: options.Seed = 0,
    device: options.Device = "auto",
) -> None:
    """Is the geometry the true one? SIDE and MAD on rendered pictures with exact depth, beside controls.

    Data: a rendered set (as from derender synth), or folders image/ and depth/ with PNGs side by side.
    """
    published.check()
    from derender.baselines.controls import untrained_twin
    from derender.cli.models import open_model
    from derender.data import read_ground_truth
    from derender.evaluation import evaluate_factors, evaluate_geometry
    from derender.evaluation.reconstruction import evaluate_reconstruction
    from derender.report.score_table import factor_table, geometry_table, reconstruction_table

    net = open_model(model, device)
    truth = read_ground_truth(data, limit=limit, image_size=net.image_size)
    twin = untrained_twin(net, seed)
    with bar("decomposing") as report:
        found = evaluate_geometry(net, truth, batch_size=batch_size, untrained=twin, progress=report)
    scores = geometry_table(found, len(truth))
    tables, values = [scores], {"pictures": len(truth), "geometry": found}
    if truth.albedo is not None and truth.light is not None and truth.camera is not None:
        factors = evaluate_factors(net, truth, batch_size=batch_size)
        fresh = evaluate_factors(twin, truth, batch_size=batch_size)
        tables.append(factor_table(factors, len(truth), fresh))
        values |= {"factors": factors, "factors_untrained": fresh}
    again = evaluate_reconstruction(net, truth.images, batch_size=batch_size)
    tables.append(reconstruction_table(again, len(truth)))
    values["reconstruction"] = again
    notes = [f"depth is {scores.verdict(0)}", f"normals are {scores.verdict(1)}"]
    published.show(tables, values, notes)
