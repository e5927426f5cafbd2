"""A comparison's page: every table with its chart, settings, and what is missing; all text escaped."""

from derender.evaluation.score_table import Column, Row, ScoreTable
from derender.report.comparison import chart_of, comparison_page

EVIL = "<script>alert(1)</script>"


def scores(*cells: float | None, best: str | None = "high") -> ScoreTable:
    columns = (Column("rows", None, 0), Column("accuracy", best))  # type: ignore[arg-type]
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
