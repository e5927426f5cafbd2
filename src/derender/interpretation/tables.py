"""Shares of factors as values and tables: answers by factor, AUC lost without one, maps checked, groups.

Squared distances of features side by side are sums over factors, and so are cosines: parts of clusters and
pairs need no probe and are exact. They depend on the features' scale; ``ratio`` does not.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from derender.evaluation.score_table import Cell, Column, Interval, Row, ScoreTable, interval_column
from derender.interpretation.attribution import CHANGES, UNCHANGED, Similarity
from derender.interpretation.probe import Probe
from derender.storage.places import counted

Features = Mapping[str, np.ndarray]


@dataclass(frozen=True, eq=False)
class ClusterShares:
    """C clusters, of some sizes, each against all other rows, by F factors, (C, F) each, 0..1.

    ``share`` is the part of the squared distance between the means of cluster and rest. ``ratio`` is the
    share of the factor's own variance that lies between them (eta squared), ``chance`` that of shuffled rows.
    """

    names: tuple[str, ...]
    factors: tuple[str, ...]
    sizes: np.ndarray
    share: np.ndarray
    ratio: np.ndarray
    chance: np.ndarray


@dataclass(frozen=True, eq=False)
class PairParts:
    """Parts of the distance and the cosine of two images, (F,) by factor.

    The squared ``distance`` and the ``cosine`` add up to those of the whole features. ``own_cosine`` is of
    each factor alone, NaN where a feature is 0. ``quantile`` is the share of all pairs of images that lie
    farther apart in this factor.
    """

    factors: tuple[str, ...]
    distance: np.ndarray
    distance_share: np.ndarray
    cosine: np.ndarray
    own_cosine: np.ndarray
    quantile: np.ndarray

    @property
    def most_alike(self) -> str:
        """The factor in which the pair is closest compared with other pairs."""
        return self.factors[int(self.quantile.argmax())]


def cluster_shares(
    features: Features, clusters: np.ndarray, *, permutations: int = 20, seed: int = 0
) -> ClusterShares:
    """The share of each factor, (N, D_f) by name, in separating each of two clusters or more from the rest.

    ``clusters`` are (N,) names or numbers; ``permutations`` of the rows give the chance level.
    """
    names = np.unique(clusters)
    if len(names) < 2:
        raise ValueError(f"a cluster is compared with others: {len(clusters)} rows form {len(names)} cluster")
    member, count = np.asarray(clusters)[:, None] == names, len(clusters)  # (N, C)
    sizes = member.sum(axis=0)
    centred = [np.asarray(v, np.float64) - np.asarray(v, np.float64).mean(axis=0) for v in features.values()]
    total = np.array([(values**2).sum() for values in centred])

    def between(member: np.ndarray) -> np.ndarray:
        """Sum of squares between each cluster and the rest, by factor: (C, F)."""
        means = [member.T.astype(np.float64) @ values / sizes[:, None] for values in centred]
        apart = np.stack([(values**2).sum(axis=1) for values in means], axis=1)  # |mean of the cluster|^2
        return apart * (sizes * count / (count - sizes))[:, None]

    generator, result = np.random.default_rng(seed), between(member)
    shuffled = [between(generator.permutation(member)) for _ in range(permutations)]
    distance = result / (sizes * (count - sizes) / count)[:, None]
    share = _over(distance, distance.sum(axis=1, keepdims=True))
    ratio, chance = _over(result, total), _over(np.mean(shuffled, axis=0), total)
    return ClusterShares(tuple(map(str, names)), tuple(features), sizes, share, ratio, chance)


def pair_parts(
    features: Features, first: int, second: int, *, pairs: int = 2_000, seed: int = 0
) -> PairParts:
    """Parts of distance and cosine of two of N rows, by factor, (N, D_f); place among random ``pairs``."""
    rows = [np.asarray(values, np.float64) for values in features.values()]
    generator, count = np.random.default_rng(seed), len(rows[0])
    one = generator.integers(count, size=pairs)
    other = (one + generator.integers(1, max(count, 2), size=pairs)) % count

    def apart(one: Sequence[int] | np.ndarray, other: Sequence[int] | np.ndarray) -> np.ndarray:
        return np.stack([((v[one] - v[other]) ** 2).sum(axis=1) for v in rows])  # (F, pairs)

    distance = apart([first], [second])
    inner = np.array([v[first] @ v[second] for v in rows])
    lengths = np.array([np.linalg.norm(v[[first, second]], axis=1) for v in rows])  # (F, 2)
    own, whole = lengths.prod(axis=1), np.linalg.norm(lengths, axis=0).prod()
    shares = _over(distance[:, 0], distance.sum()), _over(inner, whole)
    own_cosine = np.divide(inner, own, out=np.full(len(rows), np.nan), where=own > 0)
    quantile = (apart(one, other) > distance).mean(axis=1)
    return PairParts(tuple(features), distance[:, 0], *shares, own_cosine, quantile)


def _over(part: np.ndarray, whole: np.ndarray | float) -> np.ndarray:
    return np.divide(part, whole, out=np.zeros_like(part), where=np.asarray(whole) > 0)


@dataclass(frozen=True, eq=False)
class ShareRow:
    """Shares of one set of features; S seeds, A labels or classes, F factors.

    ``shares`` (S, A, F) are means over test images of the share of |IG|, with the 95 % interval ``low`` to
    ``high`` (A, F). ``auc`` (S, A) is the area under the ROC curve. Of that ``drop`` (S, A, F) is lost when
    this factor's features are exchanged. ``error`` is the largest completeness error over the largest change.
    """

    name: str
    control: bool
    shares: np.ndarray
    low: np.ndarray
    high: np.ndarray
    auc: np.ndarray
    drop: np.ndarray
    error: float

    def numbers(self, names: Sequence[str], factors: Sequence[str]) -> dict[str, Any]:
        """As JSON takes it, by label and factor."""
        spread = self.shares.std(axis=0, ddof=1) if len(self.shares) > 1 else np.full(self.low.shape, None)
        parts = {
            "share": self.shares.mean(axis=0), "low": self.low, "high": self.high, "spread": spread,
            "drop": self.drop.mean(axis=0),
        }  # fmt: skip
        answers = {}
        for answer, name in enumerate(names):
            own = {part: values[answer] for part, values in parts.items()}
            shown = {factor: {part: own[part][at] for part in own} for at, factor in enumerate(factors)}
            answers[name] = {"auc": self.auc[:, answer].mean(), "factors": shown}
        return {"control": self.control, "completeness_error": self.error, "answers": answers}


@dataclass(frozen=True, eq=False)
class Explanation:
    """Shares of F factors in A answers, of the model's features first, then of the controls.

    ``probe`` and ``shuffled`` are the first seed's, on true and on shuffled labels; ``head``, ``output`` and
    ``baseline`` say how probes were fitted and attributed.
    """

    kind: str
    names: tuple[str, ...]
    factors: tuple[str, ...]
    rows: tuple[ShareRow, ...]
    probe: Probe
    shuffled: Probe
    n_train: int
    n_test: int
    head: str
    output: str
    baseline: str

    def numbers(self) -> dict[str, Any]:
        """Everything as JSON takes it."""
        facts = {name: value for name, value in vars(self).items() if name not in ("probe", "shuffled")}
        return {**facts, "rows": {row.name: row.numbers(self.names, self.factors) for row in self.rows}}


AUC = Column("AUC", note="area under the ROC curve on held-out images, chance 0.5, best 1")


def share_table(result: Explanation) -> ScoreTable:
    """One row for each label or class, their mean first; the means of the controls last."""
    note = "share of the sum of |integrated gradients|, 0 to 1"
    shares = [Column(factor, note=note) for factor in result.factors]
    columns = [column for share in shares for column in (share, interval_column(share, "images"))]
    model = result.rows[0]

    def cells(row: ShareRow, answer: int | None) -> list[Cell]:
        shown: list[Cell] = []
        ends = np.stack((row.low, row.high), axis=-1).tolist()
        for place, share in enumerate(_means(row.shares, answer)):
            shown += [share, None if answer is None else Interval(*ends[answer][place])]
        return [*shown, *_means(row.auc[..., None], answer)]

    what = "yes/no labels" if result.kind == "labels" else "classes, each on its own images"
    seeds = f"{result.n_test:,} held out, {counted(len(model.shares), 'seeds')}, {len(result.names)} {what}"
    how = f"{result.output} from a {result.baseline} baseline, completeness error {model.error:.1e}"
    probe = f"{result.head} probe of {result.n_train:,} images, {seeds}"
    caption = f"Share of each factor in the answer: {probe}; {how}"
    return _answers(result, caption, [*columns, AUC], cells)


def drop_table(result: Explanation) -> ScoreTable:
    """AUC lost when one factor's features are exchanged between the held-out images."""
    columns = [Column(factor, note="AUC lost without this factor") for factor in result.factors]
    caption = "AUC lost when one factor's features are exchanged between images: a check without gradients"
    return _answers(result, caption, columns, lambda row, answer: _means(row.drop, answer))


def _answers(result: Explanation, caption: str, columns: Sequence[Column], cells: Any) -> ScoreTable:
    """A row for each answer of the model, their mean (None) first, those of controls last."""
    model, *controls = result.rows
    rows = [Row(f"mean of {len(result.names)}", cells(model, None))] if len(result.names) > 1 else []
    rows += [Row(name, cells(model, answer)) for answer, name in enumerate(result.names)]
    rows += [Row(row.name, cells(row, None), True) for row in controls]
    return ScoreTable(caption, "label" if result.kind == "labels" else "class", columns, rows)


def share_verdicts(result: Explanation) -> list[str]:
    """In words, each factor's mean share beside that of shuffled labels, largest first."""
    shares = {row.name: np.nanmean(row.shares, axis=(0, 1)) for row in result.rows}
    own, chance = shares["model"], shares["shuffled labels"]
    drop = np.nanmean(result.rows[0].drop, axis=(0, 1))
    return [
        f"{result.factors[place]}: {100 * own[place]:.0f} % of |IG| ({100 * chance[place]:.0f} % where "
        f"labels are shuffled); exchanged between images it costs {drop[place]:.3f} of the AUC"
        for place in np.argsort(-own)
    ]


def sanity_table(rows: Sequence[Similarity]) -> ScoreTable:
    """Similarity of maps when weights, labels or the image change; fresh weights first."""
    fresh_note = f"Spearman with maps of fresh weights; {UNCHANGED} or more: not trusted"
    columns = (
        Column("new weights", "low", 2, fresh_note),
        Column("its SSIM", "low", 2, "structural similarity of the same maps"),
        Column("shuffled labels", "low", 2, "Spearman with maps of a probe of shuffled labels"),
        Column("other image", None, 2, "Spearman with the map of another image"),
        Column("empty", None, 2, "share of comparisons left out because a map was empty"),
        Column("changes", None, note="whether new weights change the map"),
    )
    lines, by_change = [], ([row for row in rows if row.changed == changed] for changed in CHANGES)
    for fresh, labels, other in zip(*by_change, strict=True):
        word = "-" if fresh.empty == 1 else "yes" if fresh.spearman < UNCHANGED else "no"
        cells = (fresh.spearman, fresh.ssim, labels.spearman, other.spearman, fresh.empty, word)
        lines.append(Row(f"{fresh.method}, {fresh.factor}", cells))
    return ScoreTable("Do maps change with the learned weights? Similarity, -1 to 1", "map", columns, lines)


def unchanged(rows: Sequence[Similarity], changed: str) -> list[str]:
    """The maps that stay the same after a change, such as "random weights": not to be trusted."""
    stuck = [row for row in rows if row.changed == changed and row.spearman >= UNCHANGED]
    return [f"{row.method}, {row.factor}" for row in stuck]


def cluster_share_table(result: ClusterShares) -> ScoreTable:
    """Parts of the distance of each cluster from the rest, and between-variance beside chance."""
    share = "share of the squared distance to the mean of all other images, 0 to 1"
    ratio = Column("ratio", note="share of a factor's variance between cluster and rest; in brackets chance")
    columns = [column for factor in result.factors for column in (Column(factor, note=share), ratio)]
    rows, by_row = [], (result.names, result.sizes, result.share, result.ratio, result.chance)
    for name, size, *parts in zip(*by_row, strict=True):
        cells: list[Cell] = [int(size)]
        for own, between, chance in zip(*parts, strict=True):
            cells += [float(own), f"{between:.3f} ({chance:.3f})"]
        rows.append(Row(f"cluster {name}", cells))
    caption = "Each cluster against the rest: parts of the squared distance, ratios of variances (by chance)"
    return ScoreTable(caption, "cluster", [Column("images"), *columns], rows)


def pair_table(result: PairParts, names: tuple[str, str]) -> ScoreTable:
    """Parts of the distance and cosine of two images, by factor and in all."""
    columns = (
        Column("of the distance", note="part of the squared distance, 0 to 1"),
        Column("of the cosine", note="part of the cosine of the whole features; sums to it"),
        Column("own cosine", note="cosine of this factor alone, -1 to 1"),
        Column("alike", note="share of random pairs that lie farther apart in this factor; 1 is most alike"),
    )
    parts = zip(result.distance_share, result.cosine, result.own_cosine, result.quantile, strict=True)
    rows = [Row(factor, tuple(map(float, own))) for factor, own in zip(result.factors, parts, strict=True)]
    whole = Row("all", (float(result.distance_share.sum()), float(result.cosine.sum()), None, None))
    caption = f"{names[0]} and {names[1]}: most alike in {result.most_alike}, compared with other pairs"
    return ScoreTable(caption, "factor", columns, (*rows, whole))


def _means(values: np.ndarray, answer: int | None) -> list[float | None]:
    """(S, A, F) as the mean of what is finite for each factor, over one answer or all."""
    own = values if answer is None else values[:, [answer]]
    return np.ma.masked_invalid(own).mean(axis=(0, 1)).tolist()
