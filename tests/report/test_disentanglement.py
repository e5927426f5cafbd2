"""Tables and picture of the disentanglement card, made from features whose scores are known."""

import numpy as np
import pytest

from derender.evaluation.disentanglement import (
    DisentanglementCard,
    FeatureScores,
    SwapScores,
    TrueFactor,
    correlation_matrix,
    ground_truth_scores,
    pearson,
    similarity,
)
from derender.report.matrices import Matrix, card_matrices, matrix_sheet
from derender.report.tables_disentanglement import (
    dimension_table,
    factor_r2_table,
    summary_table,
    swap_tables,
    truth_table,
)

NAMES = ("light", "camera")
MOVED = np.array([[0.9, 0.3], [0.1, 0.7]])


def card(seeds: int = 2, known: bool = True) -> DisentanglementCard:
    numbers = np.random.default_rng(0).uniform(-1, 1, (80, 2))
    blocks = {"light": numbers[:, :1], "camera": numbers[:, 1:]}
    factors = [TrueFactor(f"{name} yaw", numbers[:, k], False, (name,)) for k, name in enumerate(NAMES)]

    def scores(of: dict[str, np.ndarray], seed: int, swap: bool) -> FeatureScores:
        truth = ground_truth_scores(of, factors, dimensions="lasso", seed=seed) if known else None
        test = SwapScores(NAMES, MOVED, MOVED, MOVED[0], MOVED[1], MOVED[0] / 2, 4.0 + seed, 4.0, 80)
        return FeatureScores(pearson(of), similarity(of, seed=seed), truth, test if swap else None)

    noise = {name: values[::-1] for name, values in blocks.items()}
    rows = {
        "model": [scores(blocks, seed, True) for seed in range(seeds)],
        "shuffled rows": [scores(noise, seed, False) for seed in range(seeds)],
    }
    return DisentanglementCard(NAMES, rows, correlation_matrix(blocks), (1, 1), 80)


def test_rows_are_means_with_the_spread_over_seeds_below():
    table = summary_table(card())
    assert [row.name for row in table.rows] == ["model", "  ± 2 seeds", "shuffled rows", "  ± 2 seeds"]
    assert table.values()["model"]["swap"] == 4.5
    assert table.rows[1].cells[4] == "0.707" and table.rows[2].cells[4] is None
    assert "80 pictures" in table.caption and "2 seeds" in table.caption
    assert [row.name for row in summary_table(card(1)).rows] == ["model", "shuffled rows"]


def test_tables_against_the_true_factors():
    made = card()
    truth, dimensions, single = truth_table(made), dimension_table(made), factor_r2_table(made)
    assert truth is not None and dimensions is not None and single is not None
    assert truth.values()["model"]["placed"] == 1 and truth.values()["shuffled rows"]["I"] < 0.1
    assert dimensions.values()["model"]["C, grouped"] > 0.9
    cells = single.values()["light yaw"]
    assert list(cells) == ["light", "camera", "all", "all, shuffled", "chance"]
    assert cells["light"] > 0.99 > 0.2 > cells["camera"] and cells["chance"] == 0
    assert truth_table(card(known=False)) is None and factor_r2_table(card(known=False)) is None


def test_swap_tables_hold_the_matrix():
    features, decoded = swap_tables(card())
    assert features.values()["light"] == {"light": 0.9, "camera": 0.3, "picture": 0.9, "left": 0.1}
    assert features.values()["nothing"]["light"] == 0.45
    assert decoded.values()["camera"] == {"light": 0.1, "camera": 0.7}


def test_the_sheet_shows_every_matrix():
    made = card_matrices(card())
    assert [m.title for m in made if "swap" in m.title] == ["swap: features", "swap: decoded"]
    assert len(made) == 7 and len(card_matrices(card(known=False))) == 6
    sheet = matrix_sheet(made, "a title")
    assert sheet.mode == "RGB" and sheet.width > 900 and sheet.height > 900
    dark = np.asarray(matrix_sheet([Matrix("m", np.ones((2, 2)), "ab", "ab")]), np.float64).mean()
    light = np.asarray(matrix_sheet([Matrix("m", np.zeros((2, 2)), "ab", "ab")]), np.float64).mean()
    assert dark < light - 40
    nothing = Matrix("m", np.full((2, 2), np.nan), "ab", "ab")
    assert light > np.asarray(matrix_sheet([nothing]), np.float64).mean() > dark


def test_names_must_fit_the_matrix():
    with pytest.raises(ValueError, match=r"m: a matrix \(2, 2\) does not fit its names \(2, 3\)"):
        Matrix("m", np.ones((2, 2)), "ab", "abc")
    with pytest.raises(ValueError, match="at least one matrix"):
        matrix_sheet([])
