"""Nearest rows: against scikit-learn, with ties, blocks, known answers and bad questions."""

import numpy as np
import pytest
from sklearn.neighbors import NearestNeighbors

from derender.features import FeatureTable, neighbours
from derender.features.neighbours import nearest, same_image


@pytest.fixture
def table() -> FeatureTable:
    generator = np.random.default_rng(0)
    factors = {"geometry": generator.normal(size=(300, 16)), "light": generator.normal(size=(300, 4)) + 50}
    return FeatureTable(tuple(f"{row}.png" for row in range(300)), factors)


@pytest.mark.parametrize("metric", ["cosine", "euclidean"])
@pytest.mark.parametrize("factor", ["geometry", "light"])
def test_same_as_scikit_learn(table, factor, metric, monkeypatch):
    monkeypatch.setattr(neighbours, "BLOCK_ROWS", 64)
    rows = table.factors[factor].astype(np.float64)
    query = rows[:7] + 0.1
    results = [nearest(table, one, factor, 9, metric=metric) for one in query]
    other = NearestNeighbors(n_neighbors=9, metric=metric, algorithm="brute").fit(rows)
    distances, places = other.kneighbors(query)
    np.testing.assert_array_equal([rows for rows, _ in results], places)
    np.testing.assert_allclose([away for _, away in results], distances, atol=1e-9)


def test_equal_rows_come_in_order_and_zero_rows_are_apart():
    table = FeatureTable(tuple("abcde"), {"f": np.array([[0.0, 1], [1, 0], [1, 0], [0, 0], [1, 0]])})
    rows, away = nearest(table, np.array([2.0, 0]), "f", 4)
    assert rows.tolist() == [1, 2, 4, 0] and away.tolist() == [0, 0, 0, 1]
    assert nearest(table, np.array([2.0, 0]), "f", 99)[0].tolist() == [1, 2, 4, 0, 3]


def test_the_same_image_is_alike_in_every_factor(table, monkeypatch):
    monkeypatch.setattr(neighbours, "BLOCK_ROWS", 64)
    for rows in table.factors.values():
        rows[250] = rows[17] * (1 + 1e-6)  # a copy, rounded otherwise
    table.factors["light"][33] = table.factors["light"][17]  # another face in the same light
    codes = {name: rows[17] for name, rows in table.factors.items()}
    assert same_image(table, codes).tolist() == [17, 250]
    assert same_image(table, {"light": codes["light"]}).tolist() == [17, 33, 250]
    assert same_image(table, {"albedo": codes["light"]}).tolist() == []


@pytest.mark.parametrize(
    ("query", "factor", "more", "message"),
    [
        (np.zeros(16), "geometri", {}, "unknown factor 'geometri'; did you mean 'geometry'"),
        (np.zeros(15), "geometry", {}, "geometry has 16 numbers in this table, the query 15"),
        (np.zeros(16), "geometry", {"metric": "cosin"}, "unknown metric 'cosin'; did you mean 'cosine'"),
        (np.full(16, np.nan), "geometry", {}, "the query is not finite"),
        (np.zeros(16), "geometry", {"k": 0}, "k must be 1 or more"),
        (np.zeros(16), "geometry", {"exclude": range(300)}, "no row to find: the table has 300, 300"),
    ],
)
def test_bad_questions(table, query, factor, more, message):
    with pytest.raises(ValueError, match=message):
        nearest(table, query, factor, **more)


def test_a_fitted_picture_is_itself_though_rounding_grew_on_its_way():
    draw = np.random.default_rng(3)
    geometry, light = draw.normal(size=(4, 8)).astype(np.float32), draw.normal(size=(4, 3)).astype(np.float32)
    again = {"geometry": geometry[2] * 1.1, "light": light[2]}
    names = ("a", "b", "c", "d")
    read = FeatureTable(names, {"geometry": geometry, "light": light})
    fitted = FeatureTable(names, {"geometry": geometry, "light": light}, {}, {"fit_steps": 60})
    assert same_image(read, again).tolist() == []
    assert same_image(fitted, again).tolist() == [2]
    assert same_image(fitted, {**again, "light": light[2] * 1.1}).tolist() == []  # light is read as ever
