"""Charts, matrices and masks in colours show what the values say; a page of a comparison holds them all."""

from io import BytesIO

import numpy as np
from PIL import Image
from tests.evaluation.disentanglement.conftest import card

from derender.data import MASK_CLASSES
from derender.evaluation.bootstrap import ScoredRow, estimate, with_verdicts
from derender.evaluation.robust import CurveResult, RobustnessComparison
from derender.evaluation.score_table import Column, Row, ScoreTable
from derender.report import protocols
from derender.report.charts import Matrix, card_matrices, matrix_sheet, side_by_side
from derender.report.panel import GridLayout
from derender.report.protocols import OPACITY, chart_of, comparison_page, overlays, segmentation_sheet

EVIL = "<script>alert(1)</script>"


def scores(*cells: float | None, best: str | None = "high") -> ScoreTable:
    columns = (Column("rows", None, 0), Column("accuracy", best))
    rows = [Row(f"model {place}{EVIL}", (10, cell)) for place, cell in enumerate(cells)]
    return ScoreTable("identity: 10 rows", "features", columns, [*rows, Row("chance", (10, 0.1), True)])


def test_page_has_every_table_a_chart_settings_and_what_failed():
    more = {"facts": {"seeds": "0, 1", "data": EVIL}, "failed": ["pixels: the data is gone"]}
    tables = [scores(0.5, 0.4), scores(0.3)]
    html = comparison_page("Clustering & more", tables, lead=f"By {EVIL}.", **more).html()
    assert html.count("<table") == 2 and html.count("<svg") == 2
    assert "sortable" in html and 'aria-label="accuracy of' in html
    assert "pixels: the data is gone" in html and "<dt>seeds</dt><dd>0, 1</dd>" in html
    assert EVIL not in html and "&lt;script&gt;" in html
    assert "http://" not in html.replace("http://www.w3.org/", "") and "https://" not in html
    assert "Clustering &amp; more" in html


def test_charts_show_the_first_score_and_only_finite_numbers():
    chart = chart_of(scores(0.25, None, float("nan")))
    assert chart is not None and "0.25" in chart[0] and "model 1" not in chart[0]
    assert chart_of(scores(0.5, best=None)) is None
    assert chart_of(scores(None)) is None


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


def test_tables_say_what_was_learned_tested_and_lost():
    def row(name: str, control: bool, area: float, ends: tuple[float, float]) -> ScoredRow:
        named = {"ordinary": ends[0], "area": area, "0 deg": ends[0], "40 deg": ends[1]}
        drawn = np.linspace(-0.01, 0.01, 5)
        scores = {key: estimate([value - 0.1, value + 0.1], value + drawn) for key, value in named.items()}
        return ScoredRow(name, control, 2, scores)

    rows = with_verdicts([row("albedo", False, 0.7, (0.9, 0.5)), row("majority", True, 0.25, (0.25, 0.25))])
    curve = CurveResult("yaw", "camera yaw", (0.0, 40.0), (8, 8, 16), {"accuracy": rows})
    how = ("identity of generated faces", "classes", ("a", "b"), "logistic", {"yaw": 19}, 3, (0, 1))
    result = RobustnessComparison((curve,), *how)
    area, curve, _ = result.tables()
    assert area.caption == (
        "camera yaw, 0 to 40 degrees: accuracy of 2 classes, identity of generated faces; logistic probes on "
        "19 images, 8 to 16 tested, 2 seeds; 3 images without label left out"
    )
    cells = area.values()["albedo"]
    shown = [round(float(cells[name]), 3) for name in ("area", "ordinary", "at 40 deg", "lost")]
    assert shown == [0.7, 0.9, 0.5, 0.2]
    assert area.best(0) == cells["area"] and area.best(5) is None  # to lose nothing is no merit by itself
    assert [row.control for row in area.rows] == [False, True]
    assert list(curve.values()["majority"]) == ["0", "40"]


def test_every_class_has_a_colour_of_its_own():
    colours = protocols.palette(40)
    assert colours.shape == (40, 3) and len({tuple(row) for row in colours.tolist()}) == 40
    faces = protocols.palette(len(MASK_CLASSES)).astype(int)
    apart = np.abs(faces[:, None] - faces[None]).sum(axis=-1) + 999 * np.eye(len(faces))
    assert apart.min() > 60


def test_an_overlay_is_the_picture_under_the_classes_colour():
    pictures = np.full((1, 3, 2, 2), 100, np.uint8)
    masks = np.array([[[0, 1], [2, 3]]], np.uint8)
    (image,) = overlays(pictures, masks, 4, scale=3)
    pixels = np.asarray(image).astype(float)
    assert image.size == (6, 6)
    for (row, column), number in np.ndenumerate(masks[0]):
        expected = (1 - OPACITY) * 100 + OPACITY * protocols.palette(4)[number]
        assert np.abs(pixels[3 * row : 3 * row + 3, 3 * column : 3 * column + 3] - expected).max() <= 1


def test_the_sheet_has_a_column_for_each_answer_and_the_legend_below():
    random = np.random.default_rng(0)
    pictures = random.integers(0, 256, (2, 3, 8, 8), dtype=np.uint8)
    masks = random.integers(0, 19, (2, 8, 8), dtype=np.uint8)
    layout = GridLayout(cell=40, gap=4, margin=10, label=12)
    sheet = segmentation_sheet(pictures, masks, {"joint": masks, "random": masks}, MASK_CLASSES, layout)
    assert sheet.width == 20 + 4 * 40 + 3 * 4
    below = np.asarray(sheet)[2 * 10 + 12 + 4 + 2 * 40 + 4 :]
    colours = {tuple(row) for row in below.reshape(-1, 3).tolist()}
    assert {tuple(row) for row in protocols.palette(19).tolist()} <= colours


def test_a_chart_as_a_picture_has_a_ground_and_as_svg_has_none():
    chart = side_by_side({"light": 0.5}, lambda axes, width: axes.barh([0], [width]), "share", (3, 2))
    with Image.open(BytesIO(chart.png())) as picture:
        corner, alpha = picture.convert("RGBA").getpixel((1, 1)), picture.convert("RGBA").getchannel("A")
    assert corner == (255, 255, 255, 255) and alpha.getextrema() == (255, 255)
    assert "#ffffff" not in chart.svg() and "currentColor" in chart.svg()
