"""Which feature holds which true factor: R2, DCI, MIG and SAP, of whole features and of single dimensions.

Source: DCI: Eastwood and Williams, ICLR 2018; MIG: Chen et al., NeurIPS 2018; SAP: Kumar et al., ICLR 2018;
the weights of DCI and 20 bins for MIG as in Locatello et al., ICML 2019.

These scores were made for codes of ten dimensions, each meant to hold one factor. Here one of four features
of 256 dimensions is meant to hold a factor, in any basis. So each score is computed twice:

    by feature    a feature counts for its predictions on images that the predictor has not seen (ridge, in
                  similarity.py): R2 of a number; of a class, accuracy above that of the largest class, over
                  the possible gain. Blind to scale, order of dimensions and rotations inside a feature. The
                  score to read.
    by dimension  as published: dimensions compete with each other, so a factor spread over two dimensions of
                  the right feature costs as much as one held twice by different features.

All are 0..1 and best at 1; uninformative features score about 0. None asks whether the right feature holds a
factor; ``placed`` does. True factors are the labels of a rendered set: numbers stay numbers (light, camera),
names become classes (identity, expression, kind of car).
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from derender.evaluation.disentanglement.similarity import finite, held_out, r_squared
from derender.features import missing

BINS = 20
METHODS = ("lasso", "trees")
LASSO_PENALTIES = (0.5, 0.2, 0.1)  # a warm path to the last; as shares of the smallest one without a weight
TOLERANCE = 1e-2  # of the duality gap, in units of the target's power

_SHAPE = ("geometry", "albedo")
_KNOWN = {  # label: (name in tables, features that it belongs to)
    "ambient": ("ambient", ("light",)),
    "diffuse": ("diffuse", ("light",)),
    "light_pitch_rad": ("light pitch", ("light",)),
    "light_yaw_rad": ("light yaw", ("light",)),
    "camera_x_rad": ("camera pitch", ("camera",)),
    "camera_y_rad": ("camera yaw", ("camera",)),
    "camera_z_rad": ("camera roll", ("camera",)),
    "camera_tx": ("shift x", ("camera",)),
    "camera_ty": ("shift y", ("camera",)),
    "elevation_rad": ("elevation", ("camera",)),
    "azimuth_rad": ("azimuth", ("camera",)),
    "identity": ("identity", _SHAPE),
    "expression": ("expression", _SHAPE),
    "class": ("class", _SHAPE),
}


@dataclass(frozen=True)
class TrueFactor:
    """One factor that images were made from.

    Attributes:
        name: in tables.
        values: (N,) float64 numbers, or integers from 0 for classes.
        is_class: whether the values are classes.
        belongs_to: names of the features that ought to hold it.
    """

    name: str
    values: np.ndarray
    is_class: bool
    belongs_to: tuple[str, ...] = ()

    def targets(self) -> np.ndarray:
        """Targets of a regression: (N, 1) numbers, or (N, classes) zeros and ones."""
        if not self.is_class:
            return self.values[:, None].astype(np.float64)
        return np.eye(int(self.values.max()) + 1)[self.values]

    @property
    def largest_share(self) -> float:
        """The largest class's share; 0 for a number: the score of a constant answer."""
        return float(np.bincount(self.values).max() / len(self.values)) if self.is_class else 0.0


@dataclass(frozen=True)
class ModularityScores:
    """DCI, MIG and SAP; each 0..1, best 1.

    Attributes:
        disentanglement: each feature (or dimension) matters for one factor only.
        completeness: each factor matters in one feature only.
        informativeness: how well all features together predict the factors, mean over factors.
        mig: gap of mutual information between the best and the second best, over the factor's entropy.
        sap: gap of predictive score between the best and the second best.
    """

    disentanglement: float
    completeness: float
    informativeness: float
    mig: float
    sap: float


@dataclass(frozen=True)
class GroundTruthScores:
    """F features against K true factors.

    Attributes:
        features, factors: names of the rows and columns.
        score: (F, K) held-out R2 of numbers, at most 1 and negative where the fit does harm; accuracy of
            classes, 0..1. Best 1.
        together: (K,) the same of all features side by side.
        chance: (K,) of a constant answer: 0 for numbers, the largest class's share for classes.
        by_feature: scores of whole features.
        by_dimension: scores of single dimensions; None where they were not requested.
        grouped_dci: disentanglement and completeness of the dimensions' importances added up by feature: DCI
            as published, at the level of features; None where ``by_dimension`` is.
        placed: share of the factors that the right feature predicts best, 0..1, best 1; NaN where none of
            the features has a factor of its own.
    """

    features: tuple[str, ...]
    factors: tuple[str, ...]
    score: np.ndarray
    together: np.ndarray
    chance: np.ndarray
    by_feature: ModularityScores
    by_dimension: ModularityScores | None
    grouped_dci: tuple[float, float] | None
    placed: float


def true_factors(labels: Mapping[str, np.ndarray]) -> list[TrueFactor]:
    """The labels that are factors of a rendered scene, in a fixed order; empty for real images.

    A column is left out when a value is missing or all are the same, and a class column also when it has more
    classes than a fifth of the rows: such classes are names of single images. A set without a column of light
    or camera is not a rendered one and has none.
    """
    found = [one for one in _read_known(labels).values() if isinstance(one, TrueFactor)]
    return found if any(not factor.is_class for factor in found) else []


def left_out(labels: Mapping[str, np.ndarray]) -> dict[str, str]:
    """The factors of a rendered scene that are among the labels and left out by ``true_factors``, and why."""
    if not true_factors(labels):
        return {}
    return {name: one for name, one in _read_known(labels).items() if isinstance(one, str)}


def ground_truth_scores(
    blocks: Mapping[str, np.ndarray],
    factors: list[TrueFactor],
    *,
    dimensions: str | None = None,
    folds: int = 5,
    seed: int = 0,
) -> GroundTruthScores:
    """All scores of features by name, each (N, D), against true factors of the same N images.

    Args:
        blocks: features.
        factors: at least two.
        dimensions: method of the importances of single dimensions ("lasso", fast, or "trees", slow); None
            leaves the scores by dimension out.
        folds: of the predictions.
        seed: of the random folds, and of the trees.
    """
    if len(factors) < 2 or len(blocks) < 2:
        raise ValueError(f"needs two features and two true factors, got {len(blocks)} and {len(factors)}")
    blocks = {name: finite(values, f"feature {name!r}") for name, values in blocks.items()}
    names, everything = tuple(blocks), np.concatenate(list(blocks.values()), axis=1)
    found = [_predicted(x, factors, folds, seed) for x in (*blocks.values(), everything)]
    raw = np.array([[score for score, _, _ in row] for row in found])
    gain = np.array([[gain for _, gain, _ in row] for row in found])
    share, informativeness = gain[:-1], float(gain[-1].mean())
    gaps = [
        _information_gap(np.stack([row[k][2] for row in found[:-1]], axis=1), factor)
        for k, factor in enumerate(factors)
    ]
    owned = [k for k, factor in enumerate(factors) if set(factor.belongs_to) & set(names)]
    right = [share[:, k].max() > 0 and names[share[:, k].argmax()] in factors[k].belongs_to for k in owned]
    by_dimension, grouped = None, None
    if dimensions is not None:
        weights = importance(everything, factors, dimensions, seed=seed)
        bins = binned(everything)
        by_dimension = ModularityScores(
            *dci(weights),
            informativeness,
            mig=float(np.mean([_information_gap(bins, factor) for factor in factors])),
            sap=float(np.mean(_gap(np.stack([_single(everything, factor) for factor in factors], axis=1)))),
        )
        starts = np.cumsum([0, *(values.shape[1] for values in blocks.values())])[:-1]
        grouped = dci(np.add.reduceat(weights, starts, axis=0))
    return GroundTruthScores(
        names,
        tuple(factor.name for factor in factors),
        score=raw[:-1],
        together=raw[-1],
        chance=np.array([factor.largest_share for factor in factors]),
        by_feature=ModularityScores(
            *dci(share), informativeness, mig=float(np.mean(gaps)), sap=float(np.mean(_gap(share)))
        ),
        by_dimension=by_dimension,
        grouped_dci=grouped,
        placed=sum(right) / len(owned) if owned else float("nan"),
    )


def importance(codes: np.ndarray, factors: list[TrueFactor], method: str, *, seed: int = 0) -> np.ndarray:
    """(D, K) importance of each dimension of (N, D) codes for each of K factors; each column adds to 1.

    Absolute weights of a lasso on standardised codes (Eastwood and Williams; a class is regressed as one
    lasso for each class, the weights added up), or importances of gradient boosted trees (Locatello et al.).
    A column is 0 throughout where no dimension helps. ``seed`` matters to trees only. The lasso's penalty is
    a fixed share of the largest useful one, so scaling codes or factors changes nothing; a rotation does.
    """
    if method not in METHODS:
        raise ValueError(f"unknown method {method!r}: choose lasso or trees")
    codes = np.asarray(codes, np.float64)
    deviation = codes.std(axis=0)
    alive = deviation > 1e-9 * np.abs(codes).max(axis=0, initial=0)
    standard = (codes[:, alive] - codes[:, alive].mean(axis=0)) / deviation[alive]
    found = np.zeros((codes.shape[1], len(factors)))
    for column, factor in enumerate(factors if alive.any() else []):
        found[alive, column] = (
            _lasso(standard, factor) if method == "lasso" else _trees(standard, factor, seed)
        )
    total = found.sum(axis=0)
    return found / np.where(total > 0, total, 1)


def dci(weights: np.ndarray) -> tuple[float, float]:
    """Disentanglement and completeness of (D, K) non-negative importances, each 0..1, best 1.

    One minus the entropy, in units of the largest possible, of each row (column), weighted by the row's
    (column's) share of all importance. No importance at all scores 0 in both.
    """
    weights = np.asarray(weights, np.float64)
    if weights.ndim != 2 or min(weights.shape) < 2 or not (np.isfinite(weights) & (weights >= 0)).all():
        raise ValueError(
            f"DCI needs importances of 0 and up, two rows and columns or more, got shape {weights.shape}"
        )
    return (_concentration(weights), _concentration(weights.T)) if weights.sum() > 0 else (0.0, 0.0)


def mutual_information(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Mutual information in nats between each column of (N, D) integers and (N,) integers: (D,)."""
    table = np.zeros((a.shape[1], int(a.max()) + 1, int(b.max()) + 1))
    np.add.at(table, (np.arange(a.shape[1]), a, b[:, None]), 1 / len(b))
    product = table.sum(axis=2, keepdims=True) * table.sum(axis=1, keepdims=True)
    ratio = np.divide(table, product, out=np.ones_like(table), where=table > 0)
    return (table * np.log(ratio)).sum(axis=(1, 2))


def binned(values: np.ndarray, bins: int = BINS) -> np.ndarray:
    """Columns of (N, D) numbers as integers 0..bins-1, bins of equal width between each column's ends."""
    low, high = values.min(axis=0), values.max(axis=0)
    width = np.where(high > low, high - low, 1)
    return np.clip(((values - low) / width * bins).astype(np.int64), 0, bins - 1)


def _read_known(labels: Mapping[str, np.ndarray]) -> dict[str, TrueFactor | str]:
    """By name in tables, the factor that a label holds, or the reason why it is left out."""
    return {_KNOWN[label][0]: _read(labels[label], *_KNOWN[label]) for label in _KNOWN if label in labels}


def _read(column: np.ndarray, name: str, features: tuple[str, ...]) -> TrueFactor | str:
    if absent := int(missing(column).sum()):
        return f"{absent:,} of {len(column):,} values are missing"
    values = np.asarray(column)
    if values.dtype.kind == "f":
        if np.ptp(values) > 1e-9:
            return TrueFactor(name, values.astype(np.float64), False, features)
        return "one value for all images"
    classes = np.unique(values.astype(str), return_inverse=True)[1]
    count = int(classes.max()) + 1
    if 2 <= count <= len(values) / 5:
        return TrueFactor(name, classes, True, features)
    return "one class only" if count < 2 else f"{count:,} classes of {len(values):,} images"


def _predicted(
    x: np.ndarray, factors: list[TrueFactor], folds: int, seed: int
) -> list[tuple[float, float, np.ndarray]]:
    """For each factor: score, score above chance in 0..1, and the (N,) binned prediction from one feature."""
    targets = [factor.targets() for factor in factors]
    answers = held_out(x, np.concatenate(targets, axis=1), folds=folds, seed=seed)
    ends = np.cumsum([target.shape[1] for target in targets])
    found = []
    for factor, target, predicted in zip(factors, targets, np.split(answers, ends[:-1], axis=1), strict=True):
        if factor.is_class:
            answer, largest = predicted.argmax(axis=1), factor.largest_share
            accuracy = float((answer == factor.values).mean())
            found.append((accuracy, max(0.0, (accuracy - largest) / (1 - largest)), answer))
        else:
            share = float(np.asarray(r_squared(predicted, target, folds=folds, seed=seed))[0])
            found.append((share, max(0.0, share), binned(predicted)[:, 0]))
    return found


def _lasso(codes: np.ndarray, factor: TrueFactor) -> np.ndarray:
    """Sum over the factor's targets of absolute lasso weights, by cyclic coordinate descent."""
    from sklearn.linear_model import lasso_path

    how: dict[str, Any] = {"alphas": LASSO_PENALTIES, "tol": TOLERANCE, "max_iter": 5000}
    targets = factor.targets()
    targets = targets - targets.mean(axis=0)
    gram, weights = codes.T @ codes, np.zeros(codes.shape[1])
    for target in targets.T:
        along = codes.T @ target
        largest = np.abs(along).max() / len(codes)
        if largest > 0:
            how |= {"precompute": gram, "Xy": along / largest}
            weights += np.abs(lasso_path(codes, target / largest, **how)[1][:, -1]) * largest
    return weights


def _trees(codes: np.ndarray, factor: TrueFactor, seed: int) -> np.ndarray:
    from sklearn.ensemble import GradientBoostingClassifier, GradientBoostingRegressor

    kind = GradientBoostingClassifier if factor.is_class else GradientBoostingRegressor
    return np.asarray(kind(random_state=seed).fit(codes, factor.values).feature_importances_)


def _single(codes: np.ndarray, factor: TrueFactor) -> np.ndarray:
    """(D,) share of a dimension's variance that goes with the factor: squared correlation with a number, with
    classes the squared correlation ratio (SAP as published has an SVM's accuracy there).
    """
    centred = codes - codes.mean(axis=0)
    total = np.square(centred).sum(axis=0)
    targets = factor.targets()
    if factor.is_class:
        sums, sizes = targets.T @ centred, targets.sum(axis=0)
        explained = (np.square(sums) / np.maximum(sizes, 1)[:, None]).sum(axis=0)
    else:
        true = targets[:, 0] - targets.mean()
        explained = np.square(true @ centred) / np.square(true).sum()
    alive = total > 1e-18 * np.square(codes).sum(axis=0)
    return np.divide(explained, total, out=np.zeros_like(total), where=alive)


def _information_gap(bins: np.ndarray, factor: TrueFactor) -> float:
    """MIG of one factor: from (N, D) integers, in units of the factor's entropy."""
    true = factor.values if factor.is_class else binned(factor.values[:, None])[:, 0]
    entropy = mutual_information(true[:, None], true)[0]
    return float(_gap(mutual_information(bins, true)[:, None])[0] / entropy)


def _gap(scores: np.ndarray) -> np.ndarray:
    """Best minus second best of each column of (D, K)."""
    ordered = np.sort(scores, axis=0)
    return ordered[-1] - ordered[-2]


def _concentration(weights: np.ndarray) -> float:
    total = weights.sum(axis=1, keepdims=True)
    share = weights / np.where(total > 0, total, 1)
    entropy = -(share * np.log(np.where(share > 0, share, 1))).sum(axis=1) / np.log(weights.shape[1])
    return float(((1 - entropy) * total[:, 0]).sum() / total.sum())
