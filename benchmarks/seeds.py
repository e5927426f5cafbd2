"""How scores of trained models vary with the seed of their training.

Models are saved models or run folders that differ in their seed alone. Of real faces, people are known by
clusters, by pairs and by light: 31 people of LFW with 20 images each, pairs of LFW of the test half, and
people of Extended Yale B, of the test half and all, as in the published tables.

    python benchmarks/seeds.py runs/seed0 runs/seed1 runs/seed2 --lfw lfw64.zip --pairs lfw_pairs_dev.txt \
        --yaleb yaleb.zip --json benchmarks/results/seeds.json

Of rendered objects, scenes are compared with the truth, as networks predict them, and features of folders of
images are clustered by a label. A released model is scored beside them, and the controls are kept.

    python benchmarks/seeds.py runs/heads0 runs/heads1 runs/heads2 --released rendered-faces-64 \
        --truth generated=build/results/faces/test --truth morphable=synface64.zip::test_gt \
        --clusters generated=build/results/faces/tracks --label identity --mean-by identity --mean-by track \
        --json benchmarks/results/seeds-heads.json
"""

from argparse import Namespace
from typing import Any

from ladder import means
from machine import parser, publish

import derender
from derender.evaluation import cluster, geometry, identify, verify

LIGHT = ("<= 25", "<= 50", "<= 77", "beyond", "ward accuracy", "ward nmi")
PROTOCOLS = ("geometry", "factors")
CLUSTERS = ("accuracy", "nmi")


def of_faces(model: str, sets: Namespace) -> dict[str, float]:
    """Scores on real faces, by the names of the table's columns."""
    people = derender.embed(sets.lfw, model=model)
    clusters = cluster(people, label="identity", min_count=20, max_count=20, resamples=2)
    verified = verify(people, sets.pairs, half="test", resamples=2)
    scores = {
        **{f"LFW {name}": value for name, value in means(clusters, CLUSTERS).items()},
        **{f"pairs {name}": value for name, value in means(verified, ("accuracy", "auc")).items()},
    }
    for name, place in (("Yale B", f"{sets.yaleb}?half=test"), ("Yale B, all", sets.yaleb)):
        found = identify(derender.embed(place, model=model), resamples=2)
        scores |= {f"{name} {key}": value for key, value in means(found, LIGHT).items()}
    return scores


def of_rendered(model: str, sets: Namespace) -> tuple[dict[str, float], dict[str, float]]:
    """Scores on rendered objects, ``SET KEY``, and those of the best control of each."""
    ours, controls = {}, {}
    for name, place in (address.split("=", 1) for address in sets.truth):
        intervals = geometry(model, place, resamples=2).values["intervals"]
        for rows in (intervals[protocol] for protocol in PROTOCOLS if protocol in intervals):
            rivals = [row["scores"] for row in rows.values() if row["control"]]
            for key, score in rows["model"]["scores"].items():
                ours[f"{name} {key}"] = score["value"]
                controls[f"{name} {key}"] = min(rival[key]["value"] for rival in rivals)
    for name, place in (address.split("=", 1) for address in sets.clusters):
        scores = cluster(model, sets.label, images=place, mean_by=sets.mean_by, resamples=2)
        ours |= {f"{name} {key}": value for key, value in means(scores, CLUSTERS).items()}
        rivals = [row["scores"] for row in scores.values["rows"].values() if row["control"]]
        controls |= {f"{name} {key}": max(rival[key]["value"] for rival in rivals) for key in CLUSTERS}
    return ours, controls


def main() -> None:
    asks = parser(__doc__)
    asks.add_argument("models", nargs="+", help="trained alike, each with another seed")
    for name in ("lfw", "pairs", "yaleb", "released", "label"):
        asks.add_argument(f"--{name}")
    for name in ("truth", "clusters", "mean-by"):
        asks.add_argument(f"--{name}", action="append", default=[])
    options = asks.parse_args()
    result: dict[str, Any] = {"benchmark": "seeds", "rows": []}
    if options.released:
        result["released"], result["controls"] = of_rendered(options.released, options)
    for model in options.models:
        scores = of_rendered(model, options)[0] if options.released else of_faces(model, options)
        result["rows"].append(scores)
        print(model, scores, flush=True)
    publish(result, options.json)


if __name__ == "__main__":
    main()
