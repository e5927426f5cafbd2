"""The paper's numbers are those in the paper; a part finds its labels and says what differs."""

import re

import numpy as np
import pytest

from derender.evaluation.tables import (
    CARS,
    EMOTION,
    FACE_ATTRIBUTES,
    IDENTITY,
    LINEAR,
    SEGMENTATION,
    TABLES,
    table_named,
)
from derender.features import FeatureTable


def table(**labels) -> FeatureTable:
    return FeatureTable(("a", "b"), {"f": np.eye(2)}, labels)


def lines_of_the_paper(text: str) -> list[tuple[str, list[float]]]:
    """Every line of the paper's tables that has numbers: the method's name, and the numbers after it."""
    found = []
    for line in re.findall(r"^(.*?&.*?)\\\\", text, re.MULTILINE):
        cells = re.sub(r"\\cite\{[^}]*\}|\\textbf|\\texttt|\$.*?\$|[{}\s]", "", line).split("&")
        method = re.sub(r"\(.*?\)", "", cells[0])
        numbers = [float(cell) for cell in cells[1:] if re.fullmatch(r"0\.\d+", cell)]
        if numbers:
            found.append((method, numbers))
    return found


def test_every_number_is_the_papers(shared_data):
    printed = lines_of_the_paper(shared_data("paper.tex").read_text())
    ours = [
        (re.sub(r"\(.*?\)|\s", "", row.method), list(row.scores.values()))
        for part in (IDENTITY, EMOTION, FACE_ATTRIBUTES, LINEAR, SEGMENTATION, CARS)
        for row in part.paper
    ]
    assert len(ours) == 12 + 6 + 6 + 21 + 5 + 4
    assert not [line for line in ours if line not in printed]
    assert not [line for line in printed if line not in ours]


def test_parts_find_their_labels():
    yes_no = np.array([0, 1], np.int8)
    celeba = table(Smiling=yes_no, Young=yes_no, name=np.array(["a", "b"]))
    assert FACE_ATTRIBUTES.columns(celeba) == ("Smiling", "Young") and IDENTITY.columns(celeba) == ()
    faces = table(identity=np.array(["a", "b"]), expression=np.array(["x", "y"]))
    assert IDENTITY.columns(faces) == ("identity",) and EMOTION.columns(faces) == ("expression",)


def test_a_part_says_what_differs():
    assert EMOTION.differs("rafdb", 3_068).startswith("subset: 3,068 rows of rafdb; the paper: 3,068")
    told = SEGMENTATION.differs("celebamask", 640, "+ 160 pictures at 64 x 64, 19 classes,")
    assert told.startswith(
        "subset: 640 + 160 pictures at 64 x 64, 19 classes, of celebamask; the paper: 24,127"
    )
    assert EMOTION.differs("lfw", 500).startswith("stand-in: 500 rows of lfw for 3,068 pictures of RAF-DB")


def test_tables_are_known_by_name():
    assert {"clustering", "linear", "segmentation", "cars", "identity", "emotion"} == set(TABLES)
    assert [table_named(name).number for name in ("clustering", "linear", "segmentation", "cars")] == [
        1,
        2,
        3,
        4,
    ]
    with pytest.raises(ValueError, match="unknown table 'clusterin'; did you mean 'clustering'"):
        table_named("clusterin")
