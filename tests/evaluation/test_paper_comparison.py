"""The paper's numbers are those in the paper; a part finds its labels; the paper's lines stand below ours."""

import re

import numpy as np
import pytest

from derender.evaluation import compare
from derender.evaluation.paper_tables import CARS, EMOTION, FACE_ATTRIBUTES, IDENTITY, LINEAR, SEGMENTATION
from derender.features import FeatureTable


def table(**labels) -> FeatureTable:
    return FeatureTable(("a", "b"), {"f": np.eye(2)}, labels)


def lines_of_the_paper(text: str) -> list[tuple[str, list[float]]]:
    """Every line of the paper's tables that has numbers: the method's name, and the numbers after it."""
    results = []
    for line in re.findall(r"^(.*?&.*?)\\\\", text, re.MULTILINE):
        cells = re.sub(r"\\cite\{[^}]*\}|\\textbf|\\texttt|\$.*?\$|[{}\s]", "", line).split("&")
        method = re.sub(r"\(.*?\)", "", cells[0])
        numbers = [float(cell) for cell in cells[1:] if re.fullmatch(r"0\.\d+", cell)]
        if numbers:
            results.append((method, numbers))
    return results


def test_every_number_is_the_papers(shared_data):
    printed = lines_of_the_paper(shared_data("paper.tex").read_text())
    parts = (IDENTITY, EMOTION, FACE_ATTRIBUTES, LINEAR, SEGMENTATION, CARS)
    rows = [(row.method, list(row.scores.values())) for part in parts for row in part.paper]
    ours = [(re.sub(r"\(.*?\)|\s", "", method), scores) for method, scores in rows]
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
    told = SEGMENTATION.differs("celebamask", 640, "+ 160 images at 64 x 64, 19 classes,")
    assert told.startswith("subset: 640 + 160 images at 64 x 64, 19 classes, of celebamask; the paper: 24,1")
    assert EMOTION.differs("lfw", 500).startswith("stand-in: 500 rows of lfw for 3,068 images of RAF-DB")


WHO = np.arange(60) % 3
FEATURES = {
    "ours": [np.eye(3)[WHO] + 0.01 * np.random.default_rng(0).normal(size=(60, 3))],
    "noise": [np.random.default_rng(seed).normal(size=(60, 3)) for seed in range(2)],
}


def tables_of(repeats: int = 1) -> dict[str, list[FeatureTable]]:
    labels = {"expression": np.array(list("abc"))[WHO], "smiles": (WHO == 0).astype(np.int8)}
    labels = {name: np.repeat(values, repeats) for name, values in labels.items()}
    files = tuple(map(str, range(60 * repeats)))
    return {
        name: [
            FeatureTable(files, {"geometry": one, "albedo": one}, labels, {"layout": "lfw"})
            for one in (np.repeat(run, repeats, axis=0) for run in runs)
        ]
        for name, runs in FEATURES.items()
    }


def test_background_people_and_other_sports_cars_are_none_of_the_papers_classes():
    people = np.array(["buffy", "giles", "unknown_e02_8", "unknown_e03_1"])[np.arange(80) % 4]
    cars = np.array(["jeep", "sports", "sports"])[np.arange(60) % 3]
    names = np.array(["Willys Jeep", "Ferrari 458", "Porsche sports car"])[np.arange(60) % 3]
    for table, labels, kept, classes in (
        ("identity", {"identity": people, "track": np.arange(80).astype(str)}, 40, {"buffy", "giles"}),
        ("cars", {"class": cars, "name": names}, 40, {"jeep", "sports"}),
    ):
        count = len(next(iter(labels.values())))
        features = {"geometry": np.random.default_rng(0).normal(size=(count, 4))}
        rows = {"ours": FeatureTable(tuple(map(str, range(count))), features, labels)}
        result = compare(table, rows, factors=None, resamples=20, cache="none")
        part = result.values["parts"][table]
        assert part["n_rows"] == kept
        assert f"{count - kept} rows left out that are none" in " ".join(result.notes)
        assert part["labels"] == {"identity" if table == "identity" else "class": len(classes)}


def test_clustering_tables_have_rows_of_finch_beside_ward():
    result = compare("emotion", tables_of(), resamples=20, cache="none")
    values = result.tables[0].values()
    assert values["ours"]["accuracy"] == values["ours, FINCH"]["accuracy"] == 1
    alone = compare("emotion", tables_of(), method="finch", resamples=20, cache="none")
    assert "ours, FINCH" not in alone.tables[0].values()
    assert values["noise, FINCH"]["accuracy"] == alone.tables[0].values()["noise"]["accuracy"]
    labels = {"expression": np.array(list("aabbcd"))}  # FINCH makes three clusters at most
    few = FeatureTable(tuple("123456"), {"geometry": FEATURES["noise"][0][:6]}, labels)
    result = compare("emotion", {"few": few}, factors=None, resamples=20, cache="none")
    assert "few, FINCH" not in result.tables[0].values() and "few" in result.tables[0].values()
    assert any("FINCH left out: FINCH's finest partition" in note for note in result.notes)


def test_a_question_with_too_few_images_of_each_class_is_left_out():
    files, labels = tuple(map(str, range(24))), {name: np.arange(24) % 3 for name in ("identity", "emotion")}
    few = FeatureTable(files, {"geometry": FEATURES["noise"][0][:24]}, labels)
    how = {"factors": None, "resamples": 20, "cache": "none"}
    result = compare("clustering", {"few": few}, **how)
    assert list(result.values["parts"]) == ["emotion"]
    assert any(note.startswith("identity left out: no class has 20 members") for note in result.notes)
    with pytest.raises(ValueError, match="bring more"):
        compare("identity", {"few": few}, **how)


def test_linear_tables_and_the_papers():
    how = {"seeds": 2, "resamples": 20, "cache": "none"}
    beside, first, judged, *_ = compare("linear", tables_of(), counts=(10, 20), **how).tables
    assert [column.name for column in beside.columns] == ["10 frozen", "20 frozen", "data"]
    assert not any(row.note for row in beside.rows)  # the paper has no numbers for 10 and 20 labels
    assert "10 labelled rows, the paper's head, frozen features: 30 rows tested" in first.caption
    assert [column.name for column in first.columns] == ["accuracy", "95 %", "±", "balanced", "AP"]
    assert [row.name for row in judged.rows][:2] == ["ours: accuracy", "ours: balanced"]
    values = compare("linear", tables_of(4), counts=(100,), **how).tables[0].values()
    assert values["paper: Ours - LOOCC-LV"] == {"100 frozen": 0.8226, "data": "CelebA"}
    assert "paper: Supervised ResNet-18" not in values  # it has no frozen head
