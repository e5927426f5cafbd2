"""Identity of faces: who is this (``identify``), and are these two one person (``verify``)?

Sources: nearest neighbours by the angle of light, as on Yale B (Georghiades et al., PAMI 2001). Pairs of LFW
(Huang et al., 2007): the threshold of each fold is chosen on the others. Similarity is the cosine after the
mean of the gallery, or of the other folds' images, is subtracted.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from derender.data.layouts.layout import in_test_half, stem_of
from derender.evaluation import bootstrap
from derender.evaluation.clustering import compare_clusterings
from derender.evaluation.feature_rows import FeatureSource, is_model, prepare, subject_and_controls
from derender.evaluation.image_scores import LIGHT_BINS_DEG, binned_rows
from derender.evaluation.neighbours import unit_rows
from derender.evaluation.options import Options
from derender.evaluation.score_table import Column, Scores, judged_tables, verdict
from derender.features import FeatureTable, missing
from derender.inputs import as_model
from derender.storage.bounded import first_line, read_text

FOLDS = 10


def identify(
    features: FeatureSource, label: str = "identity", *, by: str | None = None,
    bins: Sequence[float] = LIGHT_BINS_DEG, gallery: str | None = None, centred: bool = True,
    cluster_within: float = 50.0, **options: Any,
) -> Scores:  # fmt: skip
    """Share of probes whose nearest gallery image, by cosine, shows the same person; 0 to 1, best 1.

    Args:
        features: a feature table or its ``.parquet`` file; a model or its name, with ``images``.
        label: the column of people.
        by: a column of angles, in degrees or (named ..._rad) radians, whose size groups the probes. By
            default ``light_deg`` where there is one, as in Extended Yale B.
        bins: upper edges of the groups, growing; larger angles are "beyond".
        gallery: ``COLUMN=VALUE`` of the gallery's images; by default one of each person: that of the smallest
            angle, without angles the first by name.
        centred: subtract the gallery's mean before the cosine.
        cluster_within: images up to this angle, gallery too, are also clustered into people by Ward's method.
        options: images, factors, seed, resamples, cache, ...: the fields of ``Options``.

    Raises:
        ValueError: a column is missing, the gallery is empty, or no probe shows a person of the gallery.
    """
    if list(bins) != sorted(set(bins)):
        raise ValueError(f"bins must grow, got {', '.join(map(str, bins))}")
    how = Options.of(options, keep_duplicates=True, descriptors=True)
    rows = subject_and_controls(features, how)
    ready = prepare(rows, [label])
    who, table = ready.labels[label].astype(str), ready.table
    angle = _angles(table, by)
    known = ~missing(ready.labels[label])
    shown = _gallery(table, who, angle, known, gallery)
    probe = np.flatnonzero(known & ~shown & np.isin(who, who[shown]))
    if len(probe) == 0:
        raise ValueError("no probe shows a person of the gallery: give more than one image of each person")

    def recognised(run: np.ndarray) -> np.ndarray:
        codes = unit_rows(run - run[shown].mean(axis=0) * centred)
        return who[shown][(codes[probe] @ codes[shown].T).argmax(axis=1)] == who[probe]

    right = {name: np.mean(list(map(recognised, runs)), axis=0) for name, runs in ready.features.items()}
    right["chance"] = (who[shown] == who[probe, None]).mean(axis=1)
    quiet, near = (*ready.controls, "chance"), known & (angle <= cluster_within)
    scored, columns, probes = binned_rows(right, angle[probe], how.drawn(who[probe]), quiet, bins=bins)
    if 1 < len(set(who[near])) < near.sum():
        codes = {name: [run[near] for run in runs] for name, runs in ready.features.items()}
        result = compare_clusterings(codes, {label: who[near]}, controls=ready.controls, **how.scoring).rows
        ward = {row.name: {f"ward {key}": row.scores[key] for key in ("accuracy", "nmi")} for row in result}
        both = [replace(row, scores={**row.scores, **ward[row.name]}) for row in scored]
        scored = bootstrap.with_verdicts(both)
        note = f"Ward clusters of {int(near.sum()):,} images up to {cluster_within:g} degrees, gallery too"
        columns |= {"ward accuracy": Column("Ward", "high", note=f"purity of {note}")}
        columns |= {"ward nmi": Column("Ward NMI", "high", note="normalised mutual information of the same")}
    people = len(set(who[probe]))
    measure = "cosine less the mean of the gallery" if centred else "cosine"
    sizes = f"{len(probe):,} probes of {people} people, gallery of {int(shown.sum())}"
    caption = f"Identification: {sizes}, nearest by {measure}"
    asked = "Above the strongest control? (people are resampled together)"
    tables = judged_tables(caption, "features", scored, columns, asked, deviations=())
    files, numbers = [table.files[row] for row in np.flatnonzero(shown)], bootstrap.numbers_of(scored)
    values = {"people": people, "gallery": files, "probes": probes, "centred": centred, "rows": numbers}
    notes = [*how.notes, verdict(scored[0], "all", columns["all"]), how.memory.summary()]
    return Scores(tables, values, notes, scored)


def _angles(table: FeatureTable, by: str | None) -> np.ndarray:
    """Sizes of a column of angles in degrees, (N,); NaN where no column was named and there is no light."""
    name = by or "light_deg"
    if by is None and name not in table.labels:
        return np.full(len(table), np.nan)
    values = table.label(name)
    if values.dtype.kind not in "fiu":
        raise ValueError(f"label {name!r} holds no numbers: name a column of angles in degrees")
    values = np.abs(values.astype(np.float64))
    return np.degrees(values) if name.endswith("_rad") else values


def _gallery(
    table: FeatureTable, who: np.ndarray, angle: np.ndarray, known: np.ndarray, rule: str | None
) -> np.ndarray:
    """Which rows are the gallery, (N,) bool."""
    if rule is not None:
        name, equals, value = rule.partition("=")
        if not equals:
            raise ValueError(f"the gallery {rule!r} should read COLUMN=VALUE")
        column = table.label(name)
        wanted = column == float(value) if column.dtype.kind in "fiu" else column.astype(str) == value
        if not (known & wanted).any():
            raise ValueError(f"no image has {rule}: the gallery is empty")
        return known & wanted
    rows, chosen = np.flatnonzero(known), np.zeros(len(who), bool)
    rows = rows[np.argsort(angle[rows], kind="stable")]
    chosen[rows[np.unique(who[rows], return_index=True)[1]]] = True
    return chosen


@dataclass(frozen=True)
class Pairs:
    """Pairs of image names without folder and suffix, whether each shows one person, and its fold from 0."""

    first: np.ndarray
    second: np.ndarray
    same: np.ndarray
    fold: np.ndarray

    def __len__(self) -> int:
        return len(self.first)

    def select(self, rows: np.ndarray) -> "Pairs":
        """Only these pairs."""
        return Pairs(*(column[rows] for column in vars(self).values()))


def read_pairs(path: str | Path) -> Pairs:
    """Pairs of LFW: a line ``FOLDS PAIRS``, then for each fold so many of one person and of two people.

    ``NAME 1 4`` and ``NAME 1 OTHER 2`` stand for NAME_0001 with NAME_0004, and with OTHER_0002. A first line
    with one number, as of pairsDevTest.txt, is one list, dealt into ten folds.

    Raises:
        ValueError: the file is not of this form, with its line.
    """
    try:
        lines = read_text(Path(path)).splitlines()
    except ValueError as problem:
        raise ValueError(f"{path} cannot be read as pairs: {first_line(problem)}") from problem
    head = lines[0].split() if lines else []
    if len(head) not in (1, 2) or not all(word.isdecimal() and int(word) for word in head):
        raise ValueError(f"{path}, line 1: expected FOLDS PAIRS, as LFW's pairs.txt begins, got {lines[:1]}")
    folds, count = (int(head[0]), int(head[1])) if len(head) == 2 else (1, int(head[0]))
    body = [line for line in lines[1:] if line.strip()]
    if len(body) != 2 * folds * count:
        raise ValueError(f"{path}: expected {2 * folds * count} pairs as line 1 says, got {len(body)}")
    rows = []
    for number, line in enumerate(body):
        words, matched = line.split("\t") if "\t" in line else line.split(), number % (2 * count) < count
        words = [words[0], words[1], words[0], words[2]] if matched and len(words) == 3 else words
        if len(words) != 4 or not (words[1].isdecimal() and words[3].isdecimal()):
            form = "NAME 1 4" if matched else "NAME 1 OTHER 2"
            raise ValueError(f"{path}, line {number + 2}: expected {form}, got {line!r}")
        names = (f"{name}_{int(place):04d}" for name, place in (words[:2], words[2:]))
        rows.append((*names, matched, number // (2 * count) if folds > 1 else number % FOLDS))
    return Pairs(*map(np.array, zip(*rows, strict=True)))


def verify(
    features: FeatureSource, pairs: Pairs | str | Path, *, half: str = "all", **options: Any
) -> Scores:
    """Do two images show one person? Accuracy over folds and area under the ROC curve; 0.5 by chance, best 1.

    The threshold on the cosine is chosen for each fold on the others, and so is the mean that is subtracted.

    Args:
        features: a feature table or its ``.parquet`` file; a model or its name, with ``images``.
        pairs: pairs, or a file of them in LFW's format (``read_pairs``).
        half: "development" or "test": only pairs whose people are all in that half, as many of one person as
            of two in each fold.
        options: images, factors, seed, resamples, cache, ...: the fields of ``Options``.

    Raises:
        ValueError: the pairs cannot be read, or name images that are not there.
    """
    pairs = _in_half(pairs if isinstance(pairs, Pairs) else read_pairs(pairs), half)
    how = Options.of(options, keep_duplicates=True, descriptors=True)
    names = {*pairs.first, *pairs.second}
    if is_model(features):
        features = as_model(features, device=how.device)
        known = how.at(features.image_size)
    else:
        known = features if isinstance(features, FeatureTable) else FeatureTable.read(str(features))
    stems = list(map(stem_of, known.files))
    if absent := sorted(names.difference(stems)):
        what = f"{len(absent):,} of {len(names):,} images of the pairs are not there (first {absent[0]})"
        raise ValueError(f"{what}: give the images that the pairs were drawn from")
    chosen = known.select(np.array([stem in names for stem in stems]))
    if isinstance(chosen, FeatureTable):
        features = chosen
    else:
        how = replace(how, images=chosen)
    rows = subject_and_controls(features, how)
    place = {stem_of(file): row for row, file in enumerate(rows[0].tables[0].files)}
    sides = np.array([[place[name] for name in side] for side in (pairs.first, pairs.second)])
    columns = {
        "accuracy": Column("accuracy", "high", note="share of pairs judged right, mean over folds"),
        "auc": Column("AUC", "high", note="area under the ROC curve over all pairs"),
    }
    weights, scored, errors = how.drawn(len(pairs)), [], {}
    for row in rows:
        judged = (_judged(run, sides, pairs) for run in row.arrays())
        right, cosines = map(np.stack, zip(*judged, strict=True))
        accuracy = right @ weights.T / weights.sum(axis=1)
        areas = [area_under_roc(cosine, pairs.same, weights) for cosine in cosines]
        both = np.stack((accuracy, areas), axis=2)
        scored.append(bootstrap.scored_row(row.name, row.control, columns, both))
        each = [right[:, pairs.fold == fold].mean() for fold in np.unique(pairs.fold)]
        errors[row.name] = float(np.std(each, ddof=1) / np.sqrt(len(each)))
    by_chance = dict.fromkeys(columns, bootstrap.constant(0.5, how.resamples))
    scored = bootstrap.with_verdicts([*scored, bootstrap.ScoredRow("chance", True, 1, by_chance)])
    error = Column("± SE", None, note="standard error of accuracy over folds")
    n_folds, n_same = len(set(pairs.fold.tolist())), int(pairs.same.sum())
    sizes = f"{n_same:,} pairs of one person, {len(pairs) - n_same:,} of two, {n_folds} folds"
    caption = f"Verification: {sizes}, threshold and mean from the other folds"
    asked = "Above the strongest control? (paired resamples of pairs)"
    more = {error: lambda row: errors.get(row.name)}
    every: dict[str, Any] = {"intervals": tuple(columns), "deviations": (), "more": more}
    tables = judged_tables(caption, "features", scored, columns, asked, **every)
    values: dict[str, Any] = {"pairs": len(pairs), "folds": n_folds, "images": len(names), "half": half}
    values |= {"standard_error": errors, "rows": bootstrap.numbers_of(scored)}
    notes = [*how.notes, verdict(scored[0], "accuracy", columns["accuracy"]), how.memory.summary()]
    return Scores(tables, values, notes, scored)


def _in_half(pairs: Pairs, half: str) -> Pairs:
    """The pairs whose people all lie in one half; in each fold as many of one person as of two, the first."""
    if half == "all":
        return pairs
    people = ([name.rpartition("_")[0] for name in side] for side in (pairs.first, pairs.second))
    own = np.all([[in_test_half(one) == (half == "test") for one in side] for side in people], axis=0)
    kept: list[int] = []
    for fold in np.unique(pairs.fold):
        both = [np.flatnonzero(own & (pairs.fold == fold) & (pairs.same == same)) for same in (True, False)]
        kept += [row for rows in both for row in rows[: min(map(len, both))].tolist()]
    if not kept:
        raise ValueError(f"no pair has all its people in the {half} half: use all of them")
    return pairs.select(np.array(kept))


def _judged(run: np.ndarray, sides: np.ndarray, pairs: Pairs) -> tuple[np.ndarray, np.ndarray]:
    """Whether each pair is judged right, (P,), and its cosine. No copy of (N, D) codes is made."""
    right, cosines = np.zeros(len(pairs), bool), np.zeros(len(pairs))
    square = np.einsum("nd,nd->n", run, run, dtype=np.float64)
    product = np.array([np.dot(run[a], run[b]) for a, b in sides.T], np.float64)
    for fold in np.unique(pairs.fold):
        held = pairs.fold == fold
        learned = ~held if not held.all() else held
        mean = run[np.unique(sides[:, learned])].mean(axis=0, dtype=np.float64)
        along, own = run @ mean, mean @ mean
        length = np.sqrt(np.maximum(square - 2 * along + own, 1e-12))
        cosine = (product - along[sides].sum(axis=0) + own) / length[sides].prod(axis=0)
        threshold = _best_threshold(cosine[learned], pairs.same[learned])
        right[held] = (cosine[held] >= threshold) == pairs.same[held]
        cosines[held] = cosine[held]
    return right, cosines


def _best_threshold(cosine: np.ndarray, same: np.ndarray) -> float:
    """The threshold that judges most pairs right; half-way between the two cosines around it."""
    order = np.argsort(-cosine, kind="stable")
    last = int(np.cumsum(np.where(same[order], 1, -1)).argmax())
    following = cosine[order][min(last + 1, len(order) - 1)]
    return float(cosine[order][last] + following) / 2


def area_under_roc(score: np.ndarray, positive: np.ndarray, weights: np.ndarray | None = None) -> np.ndarray:
    """Chance that a positive of (N,) outranks a negative, ties half, (B,); 0 to 1, best 1.

    ``weights`` (B, N) say how often each is drawn; by default once.
    """
    weights = np.ones((1, len(score))) if weights is None else weights.astype(np.float64)
    order = np.argsort(score, kind="stable")
    starts = np.flatnonzero(np.r_[True, np.diff(score[order]) > 0])
    sides = ((weights * side)[:, order] for side in (positive, ~positive))
    wins, losses = (np.add.reduceat(side, starts, axis=1) for side in sides)
    below = np.cumsum(losses, axis=1) - losses / 2
    return (wins * below).sum(axis=1) / (wins.sum(axis=1) * losses.sum(axis=1))
