"""The matrices of a disentanglement card as one image."""

import numpy as np
from tests.evaluation.disentanglement.conftest import card

from derender.report.charts import Matrix, card_matrices, matrix_sheet


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
