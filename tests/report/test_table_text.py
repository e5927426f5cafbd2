"""Tables as Markdown and LaTeX: what is best, what is a control, and nothing that breaks out of its cell."""

import re
import shutil
import subprocess

import pytest

from derender.report.score_table import Column, Row, ScoreTable
from derender.report.table_text import latex, markdown

TABLE = ScoreTable(
    "Scores_of 50 % | all",
    "features",
    [Column("accuracy", "high", note="0 to 1"), Column("error", "low", 1), Column("95 %")],
    [
        Row("geometry_a & b", (0.81234, 2.0, "0.8-0.9")),
        Row("pixels | raw", (0.5, 1.0, None), control=True),
        Row("{odd} $1 #2 ~^\\", (float("nan"), 3.0, "*x*")),
    ],
)


def test_markdown_is_the_table():
    lines = markdown([TABLE]).splitlines()
    assert lines[0] == "Scores_of 50 % | all"
    assert lines[2] == "| features | accuracy ↑ | error ↓ | 95 % |"
    assert lines[3] == "| :--- | ---: | ---: | ---: |"
    assert lines[4] == r"| geometry\_a & b | **0.812** | 2.0 | 0.8-0.9 |"
    assert lines[5] == r"| *pixels \| raw* | 0.500 | **1.0** | - |"
    assert lines[6].endswith(r"| - | 3.0 | \*x\* |")
    assert lines[8] == "accuracy: 0 to 1"
    assert markdown([TABLE, TABLE]).count("| features |") == 2


def test_latex_is_the_table():
    text = latex([TABLE])
    assert r"\caption{Scores\_of 50 \% | all}" in text and r"\begin{tabular}{lrrr}" in text
    assert r"features & accuracy $\uparrow$ & error $\downarrow$ & 95 \% \\" in text
    assert r"geometry\_a \& b & \textbf{0.812} & 2.0 & 0.8-0.9 \\" in text
    assert r"\textit{pixels | raw} & 0.500 & \textbf{1.0} & - \\" in text
    assert r"\{odd\} \$1 \#2 \textasciitilde{}\textasciicircum{}\textbackslash{} & - & 3.0 & *x* \\" in text
    body = re.sub(r"\\[{}]", "", text)
    assert body.count("{") == body.count("}")
    rows = [line for line in text.splitlines() if line.endswith(r"\\")]
    assert all(re.sub(r"\\&", "", line).count("&") == 3 for line in rows)


@pytest.mark.skipif(shutil.which("pdflatex") is None, reason="pdflatex is not installed")
def test_latex_compiles(tmp_path):
    source = (
        rf"\documentclass{{article}}\usepackage{{booktabs}}\begin{{document}}{latex([TABLE])}\end{{document}}"
    )
    (tmp_path / "t.tex").write_text(source, encoding="utf-8")
    command = ["pdflatex", "-halt-on-error", "-interaction=nonstopmode", "t.tex"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 0, done.stdout[-2000:]
