"""Tables from the command line: files and models in, scores beside controls and the paper's numbers out."""

from pathlib import Path

import numpy as np
import pytest
from tests.cli.conftest import coloured_people

from derender import Derenderer, FeatureTable
from derender.cli import main

ROWS = 64
QUICK = ["--resamples", "20", "--untrained-seeds", "2", "--cache"]


@pytest.fixture(scope="module")
def people(tmp_path_factory) -> Path:
    return coloured_people(tmp_path_factory.mktemp("compare") / "people", ROWS, 16)


@pytest.fixture(scope="module")
def model(tmp_path_factory) -> Path:
    net = Derenderer.from_preset("small", seed=5, image_size=32, width=4, light_width=4)
    return net.save(tmp_path_factory.mktemp("compare") / "model")


@pytest.fixture(scope="module")
def smiling(people, tmp_path_factory) -> Path:
    """Some of the images, labelled as CelebA's are."""
    folder = tmp_path_factory.mktemp("compare") / "celeba"
    (folder / "img_align_celeba").mkdir(parents=True)
    lines = ["24", "smiles bald rare"]
    for row, file in enumerate(sorted(people.rglob("*.png"))[::2][:24]):
        name = f"{row:06d}.png"
        (folder / "img_align_celeba" / name).write_bytes(file.read_bytes())
        lines.append(f"{name} {1 if row % 2 else -1} -1 {1 if row == 5 else -1}")
    (folder / "list_attr_celeba.txt").write_text("\n".join(lines))
    return folder


@pytest.fixture(scope="module")
def tables(tmp_path_factory) -> dict[str, Path]:
    """Feature tables with yes/no attributes and identities, one that knows them and two that do not."""
    folder, rng = tmp_path_factory.mktemp("tables"), np.random.default_rng(0)
    who = np.arange(ROWS * 3) % 4
    labels = {"identity": np.array(list("abef"))[who], "smiles": (who % 2).astype(np.int8)}
    labels |= {"young": (who // 2).astype(np.int8)}
    files = tuple(f"{row}.png" for row in range(len(who)))

    def write(name: str, values: np.ndarray) -> Path:
        factors = {"geometry": values, "albedo": values[:, :2]}
        return FeatureTable(files, factors, labels, {"layout": "lfw"}).write(folder / f"{name}.parquet")

    noise = rng.normal(size=(2, len(who), 4))
    values = {"good": np.eye(4)[who] + 0.05 * noise[0], "noise": noise[0], "noise2": noise[1]}
    return {name: write(name, value) for name, value in values.items()}


def test_a_clustering_table_beside_the_papers(tables, tmp_path, capsys, numbers):
    words = ["compare", "--table", "identity", "--features", f"good={tables['good']}"]
    words += ["--features", f"noise={tables['noise']}", "--features", f"noise={tables['noise2']}"]
    text = tmp_path / "table.md"
    files = ["--markdown", text, "--latex", tmp_path / "t.tex", "--html", tmp_path / "t.html"]
    told = numbers(*words, *QUICK, tmp_path / "cache", *files)[0]
    page = (tmp_path / "t.html").read_text()
    assert "<svg" in page and "good" in page and "noise" in page
    part = told["parts"]["identity"]
    assert told["number"] == 1 and list(part["rows"]) == ["good", "noise", "majority", "chance"]
    assert part["rows"]["good"]["scores"]["accuracy"]["value"] == 1
    assert part["rows"]["good"]["versus"]["accuracy"]["above"] is True
    assert part["rows"]["noise"]["runs"] == 2 and part["n_rows"] == 80  # 20 of each
    assert part["differs"].startswith("stand-in: 80 rows of lfw for 644 tracks")
    assert {row["dataset"] for row in part["paper"]} == {"BBT", "Buffy"}
    assert "paper: Ours - LOOCC-LV" in text.read_text()
    assert (tmp_path / "t.tex").read_text().count(r"\begin{table}") == 3
    assert len(list((tmp_path / "cache").iterdir())) == 6  # three of Ward, three of FINCH
    capsys.readouterr()
    assert main([*map(str, words), *QUICK, str(tmp_path / "cache")]) == 0
    shown = capsys.readouterr()
    assert "0 results computed, 6 found" in shown.err and "paper: Ours - LOOCC-L " in shown.out
    half = numbers(*words, *QUICK, tmp_path / "cache", "--half", "test", "--force", "--markdown", text)[0]
    assert half["half"] == "test" and "test half" in text.read_text()
    assert half["parts"]["identity"]["n_rows"] == 40  # of two of the four people


def test_a_model_is_embedded_once_beside_its_untrained_twins(model, people, tmp_path, capsys, numbers):
    words = ["evaluate", "linear", "-m", model, "-d", people, "--label", "class", "--counts", "20"]
    words += ["--heads", "k-NN", "--seeds", "2", *QUICK, tmp_path]
    told = numbers(*words, "--finetune", "--epochs", "1")[0]
    knn, tuned = told["parts"]
    assert list(knn["rows"]) == ["geometry + albedo", "untrained encoder", "PCA (16)", "pixels", "majority"]
    assert knn["rows"]["pixels"]["scores"]["accuracy"]["value"] > 0.5 and told["kind"] == "classes"
    assert (tuned["head"], list(tuned["rows"])) == ("fine-tuned", list(knn["rows"]))
    head = ["evaluate", "linear", "-m", model, "-d", people, "--label", "class", "--counts", "20"]
    head = numbers(*head, "--heads", "linear", "--seeds", "2", "--epochs", "1", *QUICK, tmp_path)[0]
    alone = head["parts"][0]["rows"]
    assert tuned["rows"]["pixels"]["scores"] == alone["pixels"]["scores"]  # there is nothing else to train
    clustered = ["evaluate", "cluster", "-m", model, "-d", people, "--label", "class", *QUICK, tmp_path]
    assert main([str(word) for word in [*clustered, "--method", "finch"]]) == 0
    shown = capsys.readouterr()
    assert "FINCH on geometry + albedo: partitions found, 4 classes" in " ".join(shown.out.split())
    assert "11 results computed, 14 found" in shown.err  # embeddings and PCA, and the levels' own trees


def test_the_papers_linear_table_frozen_and_fine_tuned(smiling, model, tmp_path, capsys, refused, numbers):
    words = ["compare", "--table", "linear", "-m", f"ours={model}", "-d", smiling, "--counts", "10"]
    words += ["--finetune", "--seeds", "1", "--resamples", "20", "--untrained-seeds", "1"]
    told = numbers(*words, "--cache", tmp_path)[0]
    part = told["parts"]["attributes"]
    assert part["names"] == ["smiles"]  # one is never so, one is so once
    names = ["ours", "untrained encoder", "PCA (6)", "pixels", "majority"]
    assert [(one["head"], list(one["rows"])) for one in part["parts"]] == [
        (head, names) for head in ("linear", "logistic", "k-NN", "fine-tuned")
    ]
    frozen, *_, tuned = (one["rows"] for one in part["parts"])
    assert tuned["pixels"]["scores"] == frozen["pixels"]["scores"]
    assert tuned["ours"]["scores"] != frozen["ours"]["scores"]
    assert main([*map(str, words), "--cache", str(tmp_path)]) == 0
    shown = capsys.readouterr()
    printed = " ".join(shown.err.split())
    assert "0 results computed" in printed and "10 fine-tuned" in shown.out
    assert "left out, with fewer than 2 rows of one of their answers: bald, rare" in printed
    wrong = ("compare", "--table", "identity", "-m", model, "-d", smiling, "--finetune")
    assert "give the linear table, models and images" in refused(*wrong)


def test_bad_input_is_one_line(tables, model, people, refused, tmp_path):
    good = tables["good"]
    cluster = ("evaluate", "cluster", "-f", good, "--cache", "none")
    assert "give either label" in refused(*cluster, "-l", "identity", "--attributes")
    linear = ("evaluate", "linear", "-f", good, "--cache", "none")
    assert "should read like 100,500,1000" in refused(*linear, "--attributes", "--counts", "ten")
    assert "finetune trains the encoders" in refused(*linear, "--attributes", "--finetune")
    compare = ("compare", "--table", "identity", "--cache", "none", "-f", f"good={good}")
    assert "are not among the images" in refused(*compare, "-d", people)
    assert "give features, or models and images" in refused("compare", "--table", "identity")
    assert "should read NAME=PATH" in refused("compare", "--table", "cars", "-f", f"={good}")
    assert "is a folder: name a file" in refused(*cluster, "-l", "identity", "--json", tmp_path)
    assert "--method" in refused(*compare, "--method", "wards")
    there = tmp_path / "there.md"
    there.write_text("mine")
    assert "exists already" in refused(*compare, "--markdown", there)
    assert there.read_text() == "mine"
    assert "no feature table at" in refused(*compare, "-f", f"b={tmp_path / 'none.parquet'}")
