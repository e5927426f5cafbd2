"""`derender evaluate geometry`: is the geometry the true one?"""

from typing import TYPE_CHECKING, Any

import typer

from derender.cli import feature_rows, options, scoring
from derender.cli.console import progress_bar
from derender.cli.gathered import gathered

if TYPE_CHECKING:
    from derender.data import GroundTruth

SHOWN = {"SIDE x 100": ("side", 100.0), "MAD": ("mad_deg", 1.0)}
FACTORS_SHOWN = {
    "albedo": ("albedo", 1.0),
    "one scale": ("albedo_global", 1.0),
    **{name: (name, 1.0) for name in ("light", "aligned", "camera")},
}


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
    fit_steps: options.FitSteps = None,
    resamples: feature_rows.Resamples = 1_000,
    seed: options.Seed = 0,
    device: options.Device = "auto",
    cache: feature_rows.Cache = None,
) -> None:
    """Is the geometry the true one? SIDE and MAD on rendered pictures with exact depth, beside controls.

    Data: a rendered set (as from derender synth), or folders image/ and depth/ with PNGs side by side.
    """
    published.check()
    from derender.baselines.controls import untrained_twin
    from derender.cli.evaluate.reconstruction import RECONSTRUCTION_SHOWN
    from derender.cli.models import open_model, with_fitted_scenes
    from derender.data import read_ground_truth
    from derender.evaluation import (
        FactorResult,
        GeometryResult,
        ReconstructionResult,
        evaluate_factors,
        evaluate_geometry,
        evaluate_reconstruction,
    )
    from derender.evaluation.factors import factor_rows
    from derender.evaluation.geometry import geometry_rows
    from derender.evaluation.memory_values import recall_value
    from derender.evaluation.reconstruction import component_count, reconstruction_rows
    from derender.report.score_table import factor_table, geometry_table, reconstruction_table
    from derender.report.tables_pictures import picture_verdicts, with_intervals

    net = open_model(model, device)
    truth = read_ground_truth(data, limit=limit, image_size=net.image_size)
    twin, memory = untrained_twin(net, seed), feature_rows.memory_in(cache)
    inputs = {**feature_rows.model_facts(net), **truth_facts(truth), "seed": seed, "fitted": fit_steps or 0}
    scored_net = with_fitted_scenes(net, model, fit_steps)
    with progress_bar("decomposing") as report:
        found = recall_value(
            memory, "geometry", inputs, GeometryResult,
            lambda: evaluate_geometry(
                scored_net, truth, batch_size=batch_size, untrained=twin, progress=report
            ),
        )  # fmt: skip
    scores, scored = geometry_table(found, len(truth)), geometry_rows(found, resamples)
    tables = [with_intervals(scores, scored, SHOWN)]
    notes = picture_verdicts(scored[0], SHOWN, scores.columns)
    values: dict[str, Any] = {"pictures": len(truth), "geometry": found}
    values["intervals"] = {"geometry": {row.name: row.numbers() for row in scored}}
    if truth.albedo is not None and truth.light is not None and truth.camera is not None:
        factors, fresh = (
            recall_value(
                memory, f"factors-{name}", inputs, FactorResult,
                lambda one=one: evaluate_factors(one, truth, batch_size=batch_size),
            )
            for name, one in (("model", scored_net), ("untrained", twin))
        )  # fmt: skip
        shown, rows = factor_table(factors, len(truth), fresh), factor_rows(factors, fresh, resamples)
        tables.append(with_intervals(shown, rows, FACTORS_SHOWN))
        notes += picture_verdicts(rows[0], FACTORS_SHOWN, shown.columns)
        values |= {"factors": factors, "factors_untrained": fresh}
        values["intervals"]["factors"] = {row.name: row.numbers() for row in rows}
    again = recall_value(
        memory, "reconstruction", inputs, ReconstructionResult,
        lambda: evaluate_reconstruction(
            scored_net, truth.images, components_of=truth.images, untrained=twin, batch_size=batch_size
        ),
    )  # fmt: skip
    name = f"PCA ({component_count(len(truth))})"
    shown, rows = (
        reconstruction_table(again, len(truth), name),
        reconstruction_rows(again, len(truth), resamples),
    )
    tables.append(with_intervals(shown, rows, RECONSTRUCTION_SHOWN))
    values["reconstruction"] = again
    values["intervals"]["reconstruction"] = {row.name: row.numbers() for row in rows}
    published.show(tables, values, [*notes, scoring.remembered(memory)])


def truth_facts(truth: "GroundTruth") -> dict[str, Any]:
    """Everything of the true scenes that scores depend on."""
    names = ("images", "depth", "mask", "normal", "albedo", "light", "camera")
    return {name: getattr(truth, name) for name in names if getattr(truth, name) is not None}
