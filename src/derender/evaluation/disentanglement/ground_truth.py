"""Which feature holds which true factor: R2, DCI, MIG and SAP, of whole features and of single dimensions.

Source: DCI: Eastwood and Williams, ICLR 2018; MIG: Chen et al., NeurIPS 2018; SAP: Kumar et al., ICLR 2018;
the weights of DCI and 20 bins for MIG as in Locatello et al., ICML 2019.

Each score is computed twice. *By feature*, a whole feature counts for its held-out predictions (ridge, in
similarity.py): R2 of a number; of a class, accuracy above that of the largest class, over the possible gain.
This is blind to rotations inside a feature, and the score to read. *By dimension*, as published, dimensions
compete: a factor spread over two dimensions of one feature costs as much as one held by two features.

All are 0..1 and best at 1; uninformative features score about 0. True factors are the labels of a rendered
set: numbers, or names as classes.
"""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.special import entr

from derender.evaluation.disentanglement.similarity import held_out, side_by_side
from derender.features import missing

BINS = 20
LASSO_PENALTIES = (0.5, 0.2, 0.1)  # a warm path to the last; as shares of the smallest one without a weight
TOLERANCE = 1e-2  # of the duality gap, in units of the target's power

_KNOWN = {  # by the features that they belong to, labels and their names in tables
    ("light",): {
        "ambient": "ambient", "diffuse": "diffuse",
        "light_pitch_rad": "light pitch", "light_yaw_rad": "light yaw",
    },
    ("camera",): {
        "camera_x_rad": "camera pitch", "camera_y_rad": "camera yaw", "camera_z_rad": "camera roll",
        "camera_tx": "shift x", "camera_ty": "shift y",
        "elevation_rad": "elevation", "azimuth_rad": "azimuth",
    },
    ("specular",): {"gloss_strength": "gloss", "gloss_exponent": "gloss exponent"},
    ("haze",): {"haze_beta": "haze", "haze_airlight": "airlight"},
    ("geometry", "albedo"): {"identity": "identity", "expression": "expression", "class": "class"},
}  # fmt: skip


@dataclass(frozen=True)
class TrueFactor:
    """One factor that images were made from: its name in tables, (N,) float64 numbers or integers from 0 for
    classes, and the names of the features that ought to hold it.
    """

    name: str
    values: np.ndarray
    is_class: bool
    belongs_to: tuple[str, ...] = ()

    @property
    def targets(self) -> np.ndarray:
        """Targets of a regression: (N, 1) numbers, or (N, classes) zeros and ones."""
        return np.eye(int(self.values.max()) + 1)[self.values] if self.is_class else self.values[:, None]

    @property
    def largest_share(self) -> float:
        """The largest class's share; 0 for a number: the score of a constant answer."""
        return float(np.bincount(self.values).max() / len(self.values)) if self.is_class else 0.0


@dataclass(frozen=True)
class ModularityScores:
    """DCI, MIG and SAP; each 0..1, best 1.

    Disentanglement: each feature (or dimension) matters for one factor only; completeness: each factor
    matters in one feature only; informativeness: all features together predict the factors. ``mig`` and
    ``sap`` are gaps between best and second best: of mutual information, and of predictive score.
    """

    disentanglement: float
    completeness: float
    informativeness: float
    mig: float
    sap: float


@dataclass(frozen=True)
class GroundTruthScores:
    """F features against K true factors, by name.

    ``score`` is (F, K): held-out R2 of numbers, accuracy of classes, best 1; ``together`` (K,) that of all
    features side by side, ``chance`` (K,) that of a constant answer. ``placed`` is the share of factors that
    the right feature predicts best.
    """

    features: tuple[str, ...]
    factors: tuple[str, ...]
    score: np.ndarray
    together: np.ndarray
    chance: np.ndarray
    by_feature: ModularityScores
    by_dimension: ModularityScores | None
    placed: float


def true_factors(labels: Mapping[str, np.ndarray]) -> tuple[list[TrueFactor], dict[str, str]]:
    """The labels that are factors of a rendered scene, in a fixed order, and by name why others are left out.

    Left out are columns with missing values, one value or more classes than a fifth of the rows. A set
    without a column of light or camera is not a rendered one and has none.
    """
    read: dict[str, TrueFactor | str] = {}
    for features, names in _KNOWN.items():
        here = {label: name for label, name in names.items() if label in labels}
        read |= {name: _read(labels[label], name, features) for label, name in here.items()}
    factors = [one for one in read.values() if isinstance(one, TrueFactor)]
    if all(factor.is_class for factor in factors):
        return [], {}
    return factors, {name: why for name, why in read.items() if isinstance(why, str)}


def ground_truth_scores(
    blocks: Mapping[str, np.ndarray], factors: Sequence[TrueFactor], *, dimensions: str | None = None,
    seed: int = 0,
) -> GroundTruthScores:  # fmt: skip
    """All scores of features by name, each (N, D), against two true factors or more of the same N images.

    ``dimensions`` is the method of the importances of single dimensions, "lasso"; None leaves their scores
    out. ``seed`` is of the predictions' folds.
    """
    if dimensions not in (None, "lasso"):
        raise ValueError(f"unknown method {dimensions!r} of dimensions: choose lasso or None")
    blocks = side_by_side(blocks)
    names, everything = tuple(blocks), np.concatenate(list(blocks.values()), axis=1)
    result = (_predicted(x, factors, seed) for x in (*blocks.values(), everything))
    score, gain, bins = map(np.stack, zip(*result, strict=True))
    share, informativeness = gain[:-1], float(gain[-1].mean())
    mig = float(np.mean([_information_gap(bins[:-1, k].T, factor) for k, factor in enumerate(factors)]))
    owned = [k for k, factor in enumerate(factors) if set(factor.belongs_to) & set(names)]
    right = [share[:, k].max() > 0 and names[share[:, k].argmax()] in factors[k].belongs_to for k in owned]
    by_dimension = None
    if dimensions is not None:
        weights, each = importance(everything, factors), binned(everything)
        single = np.stack([_explained(everything, factor) for factor in factors], axis=1)
        own_mig = float(np.mean([_information_gap(each, factor) for factor in factors]))
        by_dimension = ModularityScores(*dci(weights), informativeness, own_mig, float(np.mean(_gap(single))))
    return GroundTruthScores(
        names,
        tuple(factor.name for factor in factors),
        score[:-1],
        score[-1],
        np.array([factor.largest_share for factor in factors]),
        ModularityScores(*dci(share), informativeness, mig, float(np.mean(_gap(share)))),
        by_dimension,
        sum(right) / len(owned) if owned else float("nan"),
    )


def importance(codes: np.ndarray, factors: Sequence[TrueFactor]) -> np.ndarray:
    """(D, K) importance of each dimension of (N, D) codes for each of K factors; each column adds to 1.

    Absolute weights of a lasso on standardised codes, added up over classes. A column is 0 where no dimension
    helps. The penalty is a fixed share of the largest useful one, so scaling codes or factors changes
    nothing; a rotation does.
    """
    from sklearn.linear_model import lasso_path

    deviation = codes.std(axis=0)
    alive = deviation > 1e-9 * np.abs(codes).max(axis=0, initial=0)
    standard = (codes[:, alive] - codes[:, alive].mean(axis=0)) / deviation[alive]
    result = np.zeros((codes.shape[1], len(factors)))
    gram = standard.T @ standard
    how: dict[str, Any] = {"alphas": LASSO_PENALTIES, "tol": TOLERANCE, "max_iter": 5000, "precompute": gram}
    for column, factor in enumerate(factors if alive.any() else []):
        weights = np.zeros(len(gram))
        for target in (factor.targets - factor.targets.mean(axis=0)).T:
            along = standard.T @ target
            if (largest := np.abs(along).max() / len(codes)) > 0:
                path = lasso_path(standard, target / largest, Xy=along / largest, **how)[1]
                weights += np.abs(path[:, -1]) * largest
        result[alive, column] = weights / (weights.sum() or 1)
    return result


def dci(weights: np.ndarray) -> tuple[float, float]:
    """Disentanglement and completeness of (D, K) non-negative importances, each 0..1, best 1.

    One minus the entropy, in units of the largest possible, of each row (column), weighted by the row's
    (column's) share of all importance. No importance at all scores 0 in both.
    """
    scores = []
    for each in (weights, weights.T):
        total = each.sum(axis=1)
        entropy = entr(each / np.where(total > 0, total, 1)[:, None]).sum(axis=1) / np.log(each.shape[1])
        scores.append(float((1 - entropy) @ total / (total.sum() or 1)))
    return scores[0], scores[1]


def mutual_information(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Mutual information in nats between each column of (N, D) integers and (N,) integers: (D,)."""
    shape = a.shape[1], int(a.max()) + 1, int(b.max()) + 1
    cells = np.ravel_multi_index((np.arange(shape[0]), a, b[:, None]), shape)
    table = np.bincount(cells.ravel(), minlength=math.prod(shape)).reshape(shape) / len(b)
    sides = entr(table.sum(axis=2)).sum(axis=1) + entr(table.sum(axis=1)).sum(axis=1)
    return sides - entr(table).sum(axis=(1, 2))


def binned(values: np.ndarray) -> np.ndarray:
    """Columns of (N, D) numbers as integers 0..19, bins of equal width between each column's ends."""
    low, high = values.min(axis=0), values.max(axis=0)
    width = np.where(high > low, high - low, 1)
    return np.clip(((values - low) / width * BINS).astype(np.int64), 0, BINS - 1)


def _read(column: np.ndarray, name: str, features: tuple[str, ...]) -> TrueFactor | str:
    """The factor that a label holds, or the reason why it is left out."""
    if absent := int(missing(column).sum()):
        return f"{absent:,} of {len(column):,} values are missing"
    if column.dtype.kind == "f":
        varies = np.ptp(column) > 1e-9
        values = column.astype(np.float64)
        return TrueFactor(name, values, False, features) if varies else "one value for all images"
    classes = np.unique(column.astype(str), return_inverse=True)[1]
    count = int(classes.max()) + 1
    if 2 <= count <= len(column) / 5:
        return TrueFactor(name, classes, True, features)
    return "one class only" if count < 2 else f"{count:,} classes of {len(column):,} images"


def _predicted(x: np.ndarray, factors: Sequence[TrueFactor], seed: int) -> Iterable[tuple[Any, ...]]:
    """From one feature, by factor: scores, (K,), those above chance in 0..1, binned predictions, (K, N)."""
    every = np.concatenate([factor.targets for factor in factors], axis=1)
    ends = np.cumsum([factor.targets.shape[1] for factor in factors])[:-1]
    answers = np.split(held_out(x, every, seed=seed), ends, axis=2)
    results = []
    for factor, (answer, constant) in zip(factors, answers, strict=True):
        if factor.is_class:
            bins, largest = answer.argmax(axis=1), factor.largest_share
            score = float((bins == factor.values).mean())
        else:
            bins, largest = binned(answer)[:, 0], 0.0
            left, total = (np.square(each - factor.targets).sum() for each in (answer, constant))
            score = float(1 - left / total)
        results.append((score, max(0.0, (score - largest) / (1 - largest)), bins))
    return zip(*results, strict=True)


def _explained(codes: np.ndarray, factor: TrueFactor) -> np.ndarray:
    """(D,) share of a dimension's variance that goes with the factor: squared correlation with a number, with
    classes the squared correlation ratio (SAP as published has an SVM's accuracy there).
    """
    centred, targets = codes - codes.mean(axis=0), factor.targets
    if not factor.is_class:
        targets = targets - targets.mean()
    explained = (np.square(targets.T @ centred) / np.square(targets).sum(axis=0)[:, None]).sum(axis=0)
    total = np.square(centred).sum(axis=0)
    alive = total > 1e-18 * np.square(codes).sum(axis=0)
    return np.divide(explained, total, out=np.zeros_like(total), where=alive)


def _information_gap(bins: np.ndarray, factor: TrueFactor) -> float:
    """MIG of one factor: from (N, D) integers, in units of the factor's entropy."""
    true = factor.values if factor.is_class else binned(factor.values[:, None])[:, 0]
    entropy = mutual_information(true[:, None], true)[0]
    return float(_gap(mutual_information(bins, true)[:, None])[0] / entropy)


def _gap(scores: np.ndarray) -> np.ndarray:
    """Best minus second best of each column of (D, K)."""
    return np.diff(np.sort(scores, axis=0)[-2:], axis=0)[0]
