"""Tables of scores that are means over pictures, with their intervals put beside them."""

from collections.abc import Mapping, Sequence
from math import isfinite

from derender.evaluation.bootstrap import ScoredRow
from derender.evaluation.score_table import Cell, Column, Row, ScoreTable, interval_column, interval_of


def with_intervals(
    table: ScoreTable, scored: Sequence[ScoredRow], scores: Mapping[str, tuple[str, float]]
) -> ScoreTable:
    """The table with a column of intervals behind every score that has them.

    Args:
        table: rows by the names of ``scored``; a row without scores of its own gets dashes.
        scored: the same rows with their resamples.
        scores: by name of a column, the score that it shows and by what it is multiplied there.
    """
    found = {row.name: row for row in scored}
    columns: list[Column] = []
    for column in table.columns:
        columns += [column, interval_column(column, "pictures")] if column.name in scores else [column]
    rows = []
    for row in table.rows:
        cells: list[Cell] = []
        for column, cell in zip(table.columns, row.cells, strict=True):
            cells.append(cell)
            if column.name in scores:
                score, scale = scores[column.name]
                own = found.get(row.name)
                cells.append(interval_of(own, score, scale) if own and score in own.scores else None)
        rows.append(Row(row.name, cells, row.control, row.note))
    return ScoreTable(table.caption, table.first, columns, rows)


def picture_verdicts(
    row: ScoredRow, scores: Mapping[str, tuple[str, float]], columns: Sequence[Column]
) -> list[str]:
    """In words, for every score of ``with_intervals``: how the row stands to the strongest control."""
    told = []
    for column in columns:
        if column.name not in scores:
            continue
        score, scale = scores[column.name]
        one = row.versus.get(score)
        if one is None or not isfinite(one.low):
            continue
        found = "better than" if one.above else "worse than" if one.high < 0 else "not distinguished from"
        ends = [f"{scale * value:+.{column.digits}f}" for value in (one.value, one.low, one.high)]
        told.append(
            f"{column.name}: {scale * row.scores[score].value:.{column.digits}f}, {found} the strongest "
            f"control ({one.rival}), by {ends[0]}, 95 % {ends[1]} to {ends[2]}"
        )
    return told
