"""The split of a model's training stays with copies of it: what it has not seen can still be asked."""

import json

import pytest
from tests.cli.conftest import face_files, settings

import derender
from derender.cli import main
from derender.data import read_images
from derender.inputs import copy_split, part_of, split_of
from derender.storage.folder import SplitRecord, read_split, write_split
from derender.storage.places import SPLIT_FILE
from derender.training.config import TrainConfig
from derender.training.run_folder import start_run

RECORD = SplitRecord((0.5, 0.2, 0.3), 4)
COPIES = ("run", "white", "again", "small")
OTHERS = ('{"format": 2, "shares": [1, 0, 0], "seed": 0}', '{"format": 1, "shares": [1, 1, 1], "seed": 0}')


@pytest.fixture(scope="module")
def pictures(tmp_path_factory):
    return str(face_files(tmp_path_factory.mktemp("faces"), 30, seed=9))


@pytest.fixture
def run(tmp_path):
    """A run folder as training leaves it: its configuration and a model."""
    folder = start_run(tmp_path / "run", TrainConfig(split=RECORD.shares, seed=RECORD.seed), {}, "cpu").path
    derender.load("rendered-faces-64").save(folder / "model")
    return folder


@pytest.mark.parametrize("text", ["{", "[]", *OTHERS])
def test_a_damaged_file_is_named(tmp_path, text):
    (tmp_path / SPLIT_FILE).write_text(text)
    with pytest.raises(ValueError, match=r"split\.json is damaged or of a newer version"):
        read_split(tmp_path)


def test_copies_of_copies_have_the_parts_of_the_run(run, pictures, tmp_path):
    assert split_of(str(run)) == RECORD
    for copy, of in (("white", "run"), ("again", "white")):
        told = ["whiten", "-m", str(tmp_path / of), "-d", pictures, "-o", str(tmp_path / copy)]
        told += settings("pictures=8", "views=1", "directions=4", "spatial=false", "examples=4")
        assert main(told) == 0
    assert main(["pack", "-m", str(tmp_path / "run"), "-o", str(tmp_path / "small")]) == 0
    every = read_images(pictures, 64)
    for part in ("train", "validation", "test"):
        asked = [set(part_of(every, part, str(tmp_path / name)).files) for name in COPIES]
        assert asked[0] == asked[1] == asked[2] == asked[3] and 0 < len(asked[0]) < 30


def test_what_learnt_from_all_pictures_has_no_parts(run, pictures, tmp_path, capsys):
    short = ("images=4", "batch_size=4", "fitted=4", "fit_steps=1", "whitening.pictures=0", "examples=4")
    for part in ("all", "train"):
        told = ["refine", "-m", str(run), "-d", pictures, "-o", str(tmp_path / part), "--part", part]
        assert main([*told, *settings(*short)]) == 0
    assert split_of(str(tmp_path / "all")) is None and split_of(str(tmp_path / "train")) == RECORD
    capsys.readouterr()
    asked = ["evaluate", "reconstruction", "-m", str(tmp_path / "all"), "-d", pictures, "--part", "test"]
    assert main(asked) == 2
    assert "records no split: use part all" in capsys.readouterr().err


def test_it_goes_with_weights_that_are_given_away(tmp_path):
    model = derender.load("rendered-faces-64")
    own = model.save(tmp_path / "own")
    assert read_split(own) is None
    write_split(own, RECORD)
    assert read_split(own) == RECORD
    given = derender.load(own).save_pretrained(tmp_path / "given", data="heads", licence="MIT")
    assert json.loads((given / SPLIT_FILE).read_text())["seed"] == 4
    copy_split(given, str(tmp_path / "nowhere"))
    assert read_split(given) == RECORD, "a model that says nothing takes nothing away"
