"""What each addition to the paper's settings gives: codes of runs that differ in one setting, over seeds.

Runs are folders named RUNG-SEED; one that the collapse detector ended counts as such and is not scored. All
scores are of images that training did not see: depth of generated heads, Ward clusters of the tracks of
generated people and of people of LFW, and people of Extended Yale B found by one image.

    python benchmarks/ladder.py runs/ladder --heads made/test --tracks made/tracks --lfw lfw64.zip \
        --yaleb yaleb.zip --json benchmarks/results/ladder.json
"""

from pathlib import Path
from typing import Any

import numpy as np
from machine import parser, publish

import derender
from derender.data import read_ground_truth
from derender.evaluation import cluster, identify
from derender.evaluation.truth import evaluate_geometry
from derender.training.run_folder import read_metrics

SCORED = ("accuracy", "nmi")
LIGHT = ("<= 25", "<= 50", "<= 77", "beyond")


def means(scores: Any, names: tuple[str, ...]) -> dict[str, float]:
    """The model's own numbers by name, without intervals."""
    row = next(row for row in scores.values["rows"].values() if not row["control"])
    return {name: row["scores"][name]["value"] for name in names}


def measured(run: Path, sets: dict[str, str], heads: Any, fit_steps: int | None) -> dict[str, float]:
    """All scores of one run; features are its codes unless it was whitened or scenes are fitted."""
    table = {name: derender.embed(place, model=run, fit_steps=fit_steps) for name, place in sets.items()}
    tracks = cluster(table["tracks"], label="identity", mean_by=("identity", "track"), resamples=2)
    people = cluster(table["lfw"], label="identity", min_count=20, max_count=20, resamples=2)
    found = identify(table["yaleb"], resamples=2)
    model = derender.load(run)
    geometry = evaluate_geometry(model, heads).model
    return {
        "SIDE x 100": 100 * float(np.mean(geometry.side)), "MAD": float(np.mean(geometry.mad_deg)),
        **{f"tracks {name}": value for name, value in means(tracks, SCORED).items()},
        **{f"LFW {name}": value for name, value in means(people, SCORED).items()},
        **{f"Yale B {name}": value for name, value in means(found, LIGHT).items()},
    }  # fmt: skip


def main() -> None:
    asks = parser(__doc__)
    asks.add_argument("runs", type=Path, help="folder of run folders")
    for name in ("heads", "tracks", "lfw", "yaleb"):
        asks.add_argument(f"--{name}", required=True)
    asks.add_argument("--fit-steps", type=int, help="optimise each scene before its features are read")
    options = asks.parse_args()
    sets = {name: getattr(options, name) for name in ("tracks", "lfw", "yaleb")}
    heads = read_ground_truth(options.heads)
    rows: list[dict[str, Any]] = []
    for run in sorted(path for path in options.runs.iterdir() if (path / "model").is_dir()):
        rung, _, seed = run.name.rpartition("-")
        ended = [row for row in read_metrics(run) if row["kind"] == "collapse"]
        row: dict[str, Any] = {"rung": rung, "seed": seed, "collapsed": bool(ended)}
        if not ended:
            row |= measured(run, sets, heads, options.fit_steps)
        rows.append(row)
        print(row, flush=True)
    publish({"benchmark": "ladder", "fit_steps": options.fit_steps, "rows": rows}, options.json)


if __name__ == "__main__":
    main()
