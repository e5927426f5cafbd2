"""The command line as a person meets it: help, a story from images to scores, and ways to get it wrong."""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from PIL import Image
from tests.cli.conftest import SETTINGS, run

from derender import FeatureTable
from derender.cli import console, main
from derender.cli.console import duration
from derender.report.decomposition import COLUMN_MEANING
from derender.settings import plain
from derender.storage.places import bundled_models
from derender.training import derender_task
from derender.training.process import TrainingInterrupted

COMMANDS = (
    *("demo", "doctor", "train", "embed", "decompose", "compare", "report", "synth faces", "synth cars"),
    *("relight", "rotate", "swap", "mesh", "search", "view"),
    *("cluster", "linear", "disentangle", "geometry", "reconstruction"),
)


def imported_by(*arguments: str | Path, among: tuple[str, ...], before: str = "pass") -> tuple[int, str, str]:
    """Exit code and output of a command in a process of its own, and which of these packages it imported."""
    code = (
        f"import sys; from derender.cli import main; {before}; code = main({list(map(str, arguments))}); "
        f"print('imported', *sorted(set({among}) & set(sys.modules)), file=sys.stderr); sys.exit(code)"
    )
    env = {**os.environ, "PYTHONPATH": str(Path(__file__).resolve().parents[2] / "src")}
    words = [sys.executable, "-c", code]
    done = subprocess.run(words, capture_output=True, text=True, env=env, check=False)
    printed, _, result = done.stderr.rpartition("imported")
    return done.returncode, done.stdout + printed, result.strip()


HEAVY = ("torch", "numpy", "numba", "matplotlib", "PIL", "sklearn", "scipy", "pyarrow")
REFUSED = {
    "nosuch.jpg does not exist": ["decompose", "nosuch.jpg", "-m", "faces-64", "-o", "x"],
    "no model at faces-46": ["decompose", __file__, "-m", "faces-46", "-o", "x"],
    "did you mean 'photo'?": ["rotate", __file__, "-m", "faces-64", "-o", "x", "--detail", "foto"],
    "choose glb or obj": ["mesh", __file__, "-m", "faces-64", "-o", "x", "--format", "stl"],
    "nosuch does not exist": ["embed", "nosuch", "-m", "faces-64", "-o", "x"],
    "choose auto, cpu or cuda": ["view", "-m", "faces-64", "--device", "gpu"],
}


def test_help_and_refusals_need_no_heavy_import():
    *others, last = REFUSED.values()
    before = f"codes = [main(words) for words in {[['--help'], *others]}]; assert codes == [0, 2, 2, 2, 2, 2]"
    code, printed, result = imported_by(*last, among=HEAVY, before=before)
    assert (code, result) == (2, ""), printed
    assert {"demo", "train", "embed", "decompose", "evaluate", "synth"} <= {*printed.split()}
    complaints = [line for line in printed.splitlines() if line.startswith("derender: ")]
    assert all(reason in line for line, reason in zip(complaints, REFUSED, strict=True)), printed


SLOW = ("numba", "matplotlib", "sklearn", "scipy", "pyarrow", "torch._dynamo", "tensorboard")


def test_one_image_is_opened_without_slow_packages(tmp_path):
    """`decompose` imports none of them, and `relight` after it in the same process not these three."""
    file, later = tmp_path / "a.png", ("sklearn", "torch._dynamo", "tensorboard")
    Image.fromarray(np.random.default_rng(0).integers(0, 256, (64, 64, 3), np.uint8)).save(file)
    first = f"assert main(['decompose', '{file}', '-o', '{tmp_path / 'parts'}']) == 0"
    first += f"; assert not {set(SLOW)} & set(sys.modules), {set(SLOW)} & set(sys.modules)"
    words = ("relight", file, "-o", tmp_path / "out", "--film", "none", "--stills", "2", "--size", "64")
    code, printed, result = imported_by(*words, among=later, before=first)
    assert (code, result) == (0, ""), printed


@pytest.mark.parametrize("command", COMMANDS)
def test_help_has_an_example_of_the_command(command, capsys):
    words = command.split() if COMMANDS.index(command) < 15 else ["evaluate", command]
    assert run(*words, "--help") == 0
    text = " ".join(capsys.readouterr().out.split())
    assert f"Example: derender {' '.join(words)}" in text
    assert "--json" in text


def test_a_run_folder_holds_model_and_report(trained: Path):
    assert (trained / "model" / "model.safetensors").is_file()
    page = (trained / "report.html").read_text()
    assert "Training run" in page and "objective.loocc" in page
    assert len(list((trained / "samples").glob("*.png"))) >= 1


def test_dry_run_shows_the_resolved_settings_and_makes_nothing(tmp_path, capsys):
    out = tmp_path / "run"
    command = ["train", "--data", "none", "--out", str(out), "--loocc", "light+camera", "--dry-run"]
    assert main([*command, *SETTINGS, "--json", "-"]) == 0
    shown = capsys.readouterr()
    assert "loocc: light+camera" in shown.err and "image_size: 32" in shown.err
    assert json.loads(shown.out)["objective"]["loocc"] == "light+camera"
    assert not out.exists()


def test_embed_then_cluster(trained, faces, tmp_path, numbers):
    table_file = tmp_path / "features.parquet"
    told, _ = numbers("embed", "--model", trained, "--data", faces, "--out", table_file)
    table = FeatureTable.read(table_file)
    assert told["rows"] == len(table) == 40
    assert told["factors"] == {name: values.shape[1] for name, values in table.factors.items()}
    assert "identity" in told["labels"]
    words = ("evaluate", "cluster", "--label", "identity")
    result, shown = numbers(*words, "--features", table_file)
    assert "geometry + albedo" in shown
    assert result["n_rows"] == 40 and result["labels"] == {"identity": 5}
    assert list(result["rows"]) == ["geometry + albedo", "majority", "chance"]
    assert 0 < result["rows"]["chance"]["scores"]["accuracy"]["value"] <= 1
    rows = numbers(*words, "-m", trained, "-d", faces, "--cache", "none")[0]["rows"]
    controls = ["untrained encoder", "PCA (10)", "pixels"]
    for name in ("Gradientfaces", "HOG", "LBP"):
        controls += [name, f"{name} with mirror image"]
    controls += ["majority", "chance"]
    assert [name for name, row in rows.items() if row["control"]] == controls
    assert list(rows) == ["geometry + albedo", *controls] and rows["untrained encoder"]["runs"] == 3


def test_decompose_writes_panels_factors_and_numbers(trained, faces, tmp_path, refused, capsys):
    first, second = sorted((faces / "images").iterdir())[:2]
    other = tmp_path / "other" / first.name
    other.parent.mkdir()
    shutil.copy(second, other)
    out = tmp_path / "apart"
    assert run("decompose", "-m", trained, first, other, "--out", out) == 0
    folders = sorted(out.iterdir())
    assert [folder.name for folder in folders] == [first.stem, f"{first.stem}-2"]
    images = {f"{name.replace(' ', '_')}.png" for name in COLUMN_MEANING}
    assert {file.name for file in folders[0].iterdir()} == {"panel.png", "scene.json", "scene.npz"} | images
    with Image.open(folders[0] / "depth.png") as depth:
        assert depth.size == (32, 32)
    record = json.loads((folders[0] / "scene.json").read_text())
    assert record["picture"] == str(first) and -60 <= record["camera"]["rotation_deg"][1] <= 60
    with np.load(folders[0] / "scene.npz") as scene:
        assert scene["depth"].shape == (32, 32) and scene["normal"].shape == (32, 32, 3)
        assert np.degrees(scene["camera"][1]) == pytest.approx(record["camera"]["rotation_deg"][1], abs=1e-4)
    assert "exists already" in refused("decompose", "-m", trained, first, "--out", out)
    (folders[0] / "panel.png").write_bytes(b"old")
    assert run("decompose", "-m", trained, first, "--out", out, "--force") == 0
    with Image.open(folders[0] / "panel.png") as panel:
        assert panel.width > 8 * 160


def test_bad_words_and_settings_name_the_nearest(refused, tmp_path):
    train = ("train", "--data", "x", "--out", tmp_path / "r")
    assert "'train'" in refused("trian")
    assert "--out" in refused("train", "--data", "x")
    assert "see derender train --help" in refused(*train, "--sett", "a=1")
    assert "--features" in refused("evaluate", "cluster", "--label", "identity")
    assert "IMAGES" in refused("evaluate", "cluster", "--label", "identity", "--model", "m")
    assert "choose auto, cpu or cuda" in refused(*train, "--device", "gpu0", *SETTINGS)
    assert "'faces'" in refused(*train, "--preset", "facs")
    assert "optimiser.learning_rate" in refused(*train, "--set", "learning_rat=3")
    assert "key=value" in refused(*train, "--set", "learning_rate")
    assert "light+camera" in refused(*train, "--loocc", "everything")


def test_bad_data(refused, tmp_path):
    train = ("train", "--out", tmp_path / "run", *SETTINGS)
    missing = tmp_path / "missing"
    assert str(missing) in refused(*train, "--data", missing)
    empty = tmp_path / "empty"
    empty.mkdir()
    assert "no images" in refused(*train, "--data", empty)
    assert "'utkface'" in refused(*train, "--data", empty, "--dataset", "utkfac")
    single = tmp_path / "single"
    single.mkdir()
    Image.new("RGB", (8, 8)).save(single / "a.png")
    assert "only one image" in refused(*train, "--data", single)
    assert not (tmp_path / "run").exists()


def test_nothing_is_written_over(trained, faces, refused, tmp_path):
    assert "--resume" in refused("train", "--data", faces, "--out", trained, *SETTINGS)
    assert "choose another folder" in refused("synth", "faces", "--out", faces)
    assert "is not empty" in refused("demo", "--out", faces)
    there = tmp_path / "there.parquet"
    there.write_text("mine")
    assert "--force" in refused("embed", "-m", trained, "-d", faces, "--out", there)
    assert there.read_text() == "mine"
    assert "is a folder" in refused("embed", "-m", trained, "-d", faces, "--out", tmp_path)
    assert "parquet" in refused("embed", "-m", trained, "-d", faces, "--out", tmp_path / "features.csv")
    assert [file.name for file in tmp_path.iterdir()] == ["there.parquet"]


def test_missing_and_damaged_models(trained, faces, refused, tmp_path):
    embed = ("embed", "--data", faces, "--out", tmp_path / "f.parquet", "--model")
    assert "no model at" in refused(*embed, tmp_path / "none")
    assert "holds no model" in refused(*embed, faces)
    damaged = tmp_path / "damaged"
    shutil.copytree(trained / "model", damaged)
    weights = damaged / "model.safetensors"
    (damaged / "split.json").unlink()
    assert "records no split" in refused(*embed, damaged, "--part", "test")
    weights.write_bytes(weights.read_bytes()[:-100])
    assert "damaged" in refused(*embed, damaged)
    assert "unknown part" in refused(*embed, trained, "--part", "tst")
    other = tmp_path / "x.parquet"
    other.write_bytes(b"nothing")
    assert str(other) in refused("evaluate", "cluster", "--features", other, "--label", "identity")
    assert "identity" in refused("evaluate", "cluster", "-m", trained, "-d", faces, "--label", "identty")


def test_resume_takes_the_stored_settings(trained, faces, tmp_path, capsys):
    copy = tmp_path / "run"
    shutil.copytree(trained, copy)
    assert run("train", "--data", faces, "--out", copy, "--resume", "--dry-run") == 0
    assert "image_size: 32" in capsys.readouterr().out
    (copy / "checkpoints" / "last").rename(copy / "checkpoints" / "gone")
    assert run("train", "--data", faces, "--out", tmp_path / "no", "--resume") == 2
    assert "no run to resume" in capsys.readouterr().err


def test_ctrl_c_says_how_to_go_on(faces, tmp_path, monkeypatch, capsys):
    def interrupted(*_, **__):
        raise TrainingInterrupted("stopped after 32 images; run the same command with --resume to go on")

    monkeypatch.setattr(derender_task, "train", interrupted)
    assert run("train", "--data", faces, "--out", tmp_path / "run", *SETTINGS) == 130
    assert capsys.readouterr().err.splitlines()[-1].endswith("with --resume to go on")


def test_a_full_disk_is_one_line(trained, faces, tmp_path, monkeypatch, refused):
    def full(*_, **__):
        raise OSError(28, "No space left on device", "f.parquet")

    monkeypatch.setattr("derender.features.embedding.write_tables", full)
    line = refused("embed", "-m", trained, "-d", faces, "--out", tmp_path / "f.parquet")
    assert line == "derender: f.parquet: no space left on device; free some space and run the command again"


def test_json_holds_no_nan_and_names_every_number():
    values = plain({"a": float("nan"), "b": np.array([1.5, np.inf]), "c": Path("x"), 3: (np.int64(2), None)})
    assert values == {"a": None, "b": [1.5, None], "c": "x", "3": [2, None]}
    assert [duration(seconds) for seconds in (9.4, 75, 3720)] == ["9 s", "1 min 15 s", "1 h 2 min"]


def test_time_left_is_counted_from_the_first_item_of_a_phase(monkeypatch, capsys):
    """Compiled code and the phase before do not make a minute into hours."""
    clock = SimpleNamespace(now=0.0, monotonic=lambda: clock.now)
    monkeypatch.setattr(console, "time", clock)
    with console.progress_bar("work") as say:
        for clock.now, done, phase in ((5000.0, 1, "before"), (5050.0, 1, "next"), (5090.0, 5, "next")):
            say(done, 11, description=phase)
    assert "next: 5 of 11 images, 1 min 0 s left" in capsys.readouterr().err


def test_every_bundled_model_is_listed_with_what_it_was_trained_on(numbers):
    rows = numbers("models")[0]["models"]
    assert [row["name"] for row in rows] == list(bundled_models())
    for row in rows:
        assert row["image_size"] == int(row["name"].rsplit("-")[-1]) and 5 < row["megabytes"] < 30
        assert row["about"].startswith("Trained on ") and len(row["about"]) < 90


def test_a_shell_is_given_completions(monkeypatch, capsys):
    words = {"_DERENDER_COMPLETE": "complete_bash", "COMP_WORDS": "derender dem", "COMP_CWORD": "1"}
    for name, value in words.items():
        monkeypatch.setenv(name, value)
    with pytest.raises(SystemExit):
        main([])
    assert capsys.readouterr().out.split() == ["demo"]
