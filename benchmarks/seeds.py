"""How scores of trained models vary with the seed of their training: people by clusters, by pairs, by light.

Models are saved models or run folders that differ in their seed alone. Sets and halves are those of the
published tables: 31 people of LFW with 20 images each, pairs of LFW and people of Extended Yale B of the test
half. Features are as `derender.embed` gives them.

    .venv/bin/python benchmarks/seeds.py runs/seed0 runs/seed1 runs/seed2 \
        --lfw lfw64.zip --pairs lfw_pairs_dev.txt --yaleb yaleb.zip --json benchmarks/results/seeds.json
"""

from ladder import means
from machine import parser, publish

import derender
from derender.evaluation import cluster, identify, verify

LIGHT = ("<= 25", "<= 50", "<= 77", "beyond", "ward accuracy", "ward nmi")


def measured(model: str, lfw: str, pairs: str, yaleb: str) -> dict[str, float]:
    """All scores of one model, by the names of the table's columns."""
    people, lit = derender.embed(lfw, model=model), derender.embed(f"{yaleb}?half=test", model=model)
    clusters = cluster(people, label="identity", min_count=20, max_count=20, resamples=2)
    verified = verify(people, pairs, half="test", resamples=2)
    return {
        **{f"LFW {name}": value for name, value in means(clusters, ("accuracy", "nmi")).items()},
        **{f"pairs {name}": value for name, value in means(verified, ("accuracy", "auc")).items()},
        **{f"Yale B {name}": value for name, value in means(identify(lit, resamples=2), LIGHT).items()},
    }


def main() -> None:
    asks = parser(__doc__)
    asks.add_argument("models", nargs="+", help="trained alike, each with another seed")
    for name in ("lfw", "pairs", "yaleb"):
        asks.add_argument(f"--{name}", required=True)
    options = asks.parse_args()
    sets = options.lfw, options.pairs, options.yaleb
    rows = []
    for model in options.models:
        rows.append(measured(model, *sets))
        print(model, rows[-1], flush=True)
    publish({"benchmark": "seeds", "rows": rows}, options.json)


if __name__ == "__main__":
    main()
