"""`derender compare`: one of the paper's tables for other features, or by plan many methods trained here."""

from dataclasses import dataclass, replace
from functools import partial

from derender.cli import options, scoring
from derender.cli.options import command, option
from derender.cli.plan import Planned, by_plan

FEATURES = "Table made by derender embed; a name given again is another seed."
MODELS = f"Model, with IMAGES: {options.MODELS}"


@dataclass(frozen=True)
class PaperTable:
    """One of the paper's tables."""

    table: str | None = option(None, "clustering, identity, emotion, linear, segmentation or cars.")
    features: list[str] | None = option(None, FEATURES, "--features", "-f", metavar="NAME=FILE.parquet")
    model: list[str] | None = option(None, MODELS, "--model", "-m", metavar="NAME=MODEL")
    factors: scoring.Factors = "geometry,albedo"
    masks: scoring.Masks = None
    method: scoring.Method = "ward"
    counts: scoring.Counts = "100,500,1000"
    seeds: int = scoring.number(5, "Number of training subsets; of runs of each net.")
    epochs: int = scoring.number(20, "Epochs of segmentation nets.")
    finetune: bool = option(False, "Also train the models' encoders.", "--finetune")
    supervised: bool = option(False, "With --finetune: also a ResNet-18 from fresh weights.", "--supervised")
    untrained_seeds: scoring.UntrainedSeeds = 3


@command("compare", "compare celeba.zip --table linear --model faces=runs/faces")
def compare(
    images: options.DataOptions,
    paper: PaperTable,
    computed: scoring.Computed,
    published: scoring.Published,
    planned: Planned,
) -> None:
    """Several models and features under one protocol, beside the paper's own numbers.

    With --plan: many methods, trained here on the same images, on many data sets and protocols.
    """
    rest = (images, paper, replace(computed, device="auto"), replace(published, json_file=None))
    if planned.plan is not None:
        if rest != (options.DataOptions(), PaperTable(), scoring.Computed(), scoring.Published()):
            raise ValueError("beside --plan go --out, --dry-run, --device, --json alone")
        by_plan(planned, computed.device, published.json_file)
        return
    if planned != Planned():
        raise ValueError("--out and --dry-run go with --plan FILE")
    if paper.table is None:
        raise ValueError("give --table NAME with --model or --features, or --plan FILE with --out DIR")
    from derender.data import half_of
    from derender.features import FeatureTable

    tables = scoring.named_paths(paper.features or (), "--features")
    models = scoring.named_paths(paper.model or (), "--model")
    halved = partial(half_of, half=images.half)
    read = {name: [halved(FeatureTable.read(path)) for path in paths] for name, paths in tables.items()}
    own = {name: value for name, value in vars(paper).items() if name not in ("table", "features", "model")}
    own |= {"factors": scoring.names_of(paper.factors)}
    own |= {"counts": scoring.numbers_of(paper.counts, "--counts")}
    given = (paper.table, {**read, **models}, images.optional_address)
    scores = scoring.measured("compare", *given, **images.how, **vars(computed), **own)
    published.publish(scores, half=images.half)
