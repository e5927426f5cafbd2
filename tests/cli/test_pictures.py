"""`relight`, `rotate`, `swap`, `mesh`, `search` and finer `decompose` as a person meets them."""

import io
import json
import os
import re
import shutil
import sys
from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest
import trimesh
from filelock import FileLock
from PIL import Image
from tests.cli.conftest import noise, run

from derender import Derenderer
from derender.report.edits import Edit
from derender.report.options import ImageOptions
from derender.report.viewer.images import rendered_examples
from derender.storage.places import ERRORS_FILE
from derender.training.held_out_errors import HeldOutErrors, write_errors
from derender.training.process import LOCK_FILE

SIZE = 32


@pytest.fixture(scope="module")
def photos(tmp_path_factory) -> Path:
    """Six images of coloured noise, 64 pixels wide."""
    return noise(tmp_path_factory.mktemp("pictures") / "photos", 6, 64, cells=8)


@pytest.fixture(scope="module")
def table(tiny, photos) -> str:
    path = photos.parent / "F.parquet"
    assert run("embed", "--model", tiny, "--data", photos, "--out", path) == 0
    return str(path)


@pytest.mark.parametrize("command", ["decompose", "relight", "rotate", "swap", "mesh"])
def test_every_field_of_the_image_options_is_an_option(command, capsys):
    assert run(command, "--help") == 0
    shown = capsys.readouterr().out
    for field in fields(ImageOptions):
        named = f"--{field.name.replace('_', '-')}" in shown
        assert named != field.metadata.get("hidden", False), field.name


def test_relight_sweeps_and_says_which_light(tiny, photos, tmp_path, numbers):
    out = tmp_path / "out"
    words = ["--stills", "3", "--frames", "4", "--size", "40", "--reach", "30", "--film", "gif"]
    told, _ = numbers("relight", "-m", tiny, photos / "0.png", photos / "1.png", "-o", out, *words)
    assert sorted(path.name for path in out.iterdir()) == ["0", "1", "sheet.png"]
    stills = json.loads((out / "0" / "moved.json").read_text())["stills"]
    assert [still["label"] for still in stills] == ["light -30°", "light 0°", "light +30°"]
    assert [round(np.degrees(still["light"][3])) for still in stills] == [-30, 0, 30]
    with Image.open(out / "1" / "still-02.png") as still:
        assert still.size == (40, 40)
    with Image.open(out / "0" / "film.gif") as film:
        assert film.n_frames == 4
    assert not (out / "0" / "film.mp4").exists()
    assert told["sheets"] == [str(out / "sheet.png")]


def test_photographs_are_decomposed_by_faces_64_unless_a_model_is_named(tmp_path):
    Image.fromarray(rendered_examples("faces-64", 64)[0].picture).save(tmp_path / "0.png")
    for name, words in (("default", ()), ("named", ("-m", "faces-64"))):
        assert run("decompose", tmp_path / "0.png", "-o", tmp_path / name, *words) == 0
    with np.load(tmp_path / "default/0/scene.npz") as one, np.load(tmp_path / "named/0/scene.npz") as other:
        assert one["depth"].shape[-1] == 64
        np.testing.assert_array_equal(one["depth"], other["depth"])


def test_relight_ends_in_the_light_of_another(tiny, photos, tmp_path):
    out = tmp_path / "out"
    words = ["--like", photos / "2.png", "--stills", 2, "--film", "none", "--size", 32]
    assert run("relight", "-m", tiny, photos / "0.png", "-o", out, *words) == 0
    first, last = json.loads((out / "0" / "moved.json").read_text())["stills"]
    assert run("decompose", "-m", tiny, photos / "2.png", "-o", tmp_path / "apart") == 0
    with np.load(tmp_path / "apart" / "2" / "scene.npz") as scene:
        np.testing.assert_allclose(last["light"], scene["light"], atol=1e-5)
        assert np.abs(np.subtract(first["light"], scene["light"])).max() > 1e-4


def test_rotate_writes_films_anyone_can_play(tiny, photos, tmp_path):
    out = tmp_path / "out"
    words = ["--stills", 2, "--frames", 3, "--size", 33, "--pitch", 5]
    assert run("rotate", "-m", tiny, photos / "0.png", "-o", out, *words) == 0
    assert (out / "0" / "film.mp4").read_bytes()[4:8] == b"ftyp"
    assert (out / "0" / "film.gif").read_bytes()[:4] == b"GIF8"
    camera = json.loads((out / "0" / "moved.json").read_text())["stills"][0]["camera"]
    assert np.degrees(camera[:2]).tolist() == pytest.approx([5, -40], abs=1e-3)
    assert not (out / "sheet.png").exists()  # one image needs none


def test_swap_of_a_picture_with_itself_changes_nothing(tiny, photos, tmp_path):
    out, one = tmp_path / "out", photos / "0.png"
    swap = ("swap", "-m", tiny, one, "-o", out, "--size", 32, "--from")
    assert run(*swap, one) == 0
    stills = json.loads((out / "0" / "moved.json").read_text())["stills"]
    assert [still["factor"] for still in stills] == ["geometry", "albedo", "light", "camera"]
    images = {(out / "0" / still["file"]).read_bytes() for still in stills}
    assert len(images) == 1
    assert run(*swap, photos / "1.png", "--factor", "albedo", "--force") == 0
    assert (out / "0" / "still-01.png").read_bytes() not in images


@pytest.mark.parametrize("edit", [["relight"], ["rotate"], ["swap", "--from", "1.png"]])
def test_edits_in_the_models_albedo_are_drawn_at_their_size(edit, tiny, photos, tmp_path, monkeypatch):
    monkeypatch.chdir(photos)
    words = ["0.png", "-m", tiny, "-o", tmp_path / "out", "--detail", "model", "--size", 48]
    assert run(*edit, *words) == 0
    with Image.open(tmp_path / "out" / "0" / "still-01.png") as still:
        assert still.size == (48, 48)


def test_mesh_opens_elsewhere_and_takes_the_pictures_own_texture(tiny, photos, tmp_path):
    for name, detail in {"own": [], "model": ["--detail", "model"], "old": ["--texture", "original"]}.items():
        words = ["mesh", "-m", tiny, photos / "0.png", "-o", tmp_path / name, "--size", 48, *detail]
        assert run(*words, "--json", tmp_path / "told.json") == 0
    told = json.loads((tmp_path / "told.json").read_text())["pictures"][0]
    content = (tmp_path / "own" / "0" / "0.glb").read_bytes()
    assert content == (tmp_path / "old" / "0" / "0.glb").read_bytes()
    read = trimesh.load(io.BytesIO(content), file_type="glb", force="mesh", process=False)
    assert len(read.vertices) == told["vertices"] and len(read.faces) == told["faces"]
    assert told["trimmed"] > 2 / 48
    assert content != (tmp_path / "model" / "0" / "0.glb").read_bytes()
    words = ["-o", tmp_path / "o", "--format", "obj", "--size", 32]
    assert run("mesh", "-m", tiny, photos / "0.png", *words) == 0
    assert {file.suffix for file in (tmp_path / "o" / "0").iterdir()} == {".obj", ".mtl", ".png"}


def test_decompose_at_another_size_with_a_sheet(tiny, photos, tmp_path):
    out = tmp_path / "out"
    words = ["--size", 48, "--detail", "photo", "--sheet"]
    assert run("decompose", "-m", tiny, photos / "0.png", photos / "1.png", "-o", out, *words) == 0
    with np.load(out / "1" / "scene.npz") as scene:
        assert scene["depth"].shape == (48, 48) and scene["albedo"].shape == (3, 48, 48)
    with Image.open(out / "sheet.png") as sheet, Image.open(out / "0" / "albedo.png") as albedo:
        assert sheet.height > 2 * 128 and albedo.size == (48, 48)


def test_search_with_a_picture_of_the_table(table, tiny, photos, tmp_path, numbers):
    """It is not found itself, whatever its name, unless copies are asked for."""
    sheet, renamed = tmp_path / "sheet.png", shutil.copy(photos / "4.png", tmp_path / "mine.png")
    words = ("search", "-f", table, "--like", renamed, "--model", tiny, "-k", "3", "--out", sheet)
    answer, printed = numbers(*words)
    assert answer["same_picture"] == ["4.png"] and len(answer["found"]) == 3
    assert "4.png" not in {row["file"] for row in answer["found"]}
    distances = [row["distance"] for row in answer["found"]]
    assert distances == sorted(distances) and distances[0] > 1e-5
    assert "left out as the very same image: 4.png (--copies" in printed
    answer, printed = numbers(*words, "--copies", "--force")
    result = answer["found"]
    assert result[0]["file"] == "4.png" and len(result) == 3 and "4.png" in printed
    assert result[0]["distance"] == pytest.approx(0, abs=1e-5)
    with Image.open(sheet) as drawn:
        assert drawn.width > 4 * 160


def test_bad_pictures_are_left_out_and_named(tiny, photos, tmp_path, capsys):
    bad = tmp_path / "bad.jpg"
    bad.write_bytes(b"no picture")
    words = ["-m", tiny, bad, photos / "0.png", "-o", tmp_path / "out", "--size", 32]
    assert run("mesh", *words) == 2
    assert f"left out {bad}" in capsys.readouterr().err
    assert [folder.name for folder in (tmp_path / "out").iterdir()] == ["0"]


def test_a_folder_goes_on_where_it_was_stopped(tiny, photos, tmp_path, numbers, monkeypatch, capsys):
    folder, out = Path(shutil.copytree(photos, tmp_path / "folder")), tmp_path / "out"
    (folder / "bad.jpg").write_bytes(b"no picture")
    words = ("rotate", "-m", tiny, folder, "-o", out, "--size", 32, "--stills", 2, "--film", "none")
    told, printed = numbers(*words)  # exit code 0: of a folder the others are used
    assert len(told["pictures"]) == 6 and "left out" in printed and (out / "sheet.png").exists()
    sheet, write, left = (out / "sheet.png").read_bytes(), Edit.write, [1, 1, 1]
    shutil.rmtree(out)

    def interrupted(*how):
        if not left:
            raise KeyboardInterrupt
        left.pop()
        return write(*how)

    with monkeypatch.context() as stop:
        stop.setattr(Edit, "write", interrupted)
        assert run(*words) == 130
    assert "finished images are kept: --resume continues" in capsys.readouterr().err
    assert not (out / "sheet.png").exists() and len(list(out.glob("[0-9]"))) == 3
    numbers(*words, "--resume")
    assert (out / "sheet.png").read_bytes() == sheet and not (out / ".sheet").exists()  # with every picture
    shutil.rmtree(out / "3")
    kept = (out / "1" / "strip.png").stat().st_mtime_ns
    told, printed = numbers(*words, "--resume")
    assert [Path(one["folder"]).name for one in told["pictures"]] == ["3"] and "5 done before" in printed
    told, printed = numbers(*words, "--resume")
    assert told["pictures"] == [] and "left out" in printed and "6 done before" in printed
    assert (out / "1" / "strip.png").stat().st_mtime_ns == kept


@pytest.mark.skipif(sys.platform != "linux", reason="file names are text there")
def test_a_name_that_is_no_utf8(tiny, photos, tmp_path, numbers):
    odd = os.fsencode(tmp_path) + b"/a\xff.png"
    shutil.copy(photos / "0.png", odd)
    for command in ("decompose", "relight"):
        words = (command, "-m", tiny, os.fsdecode(odd), "-o", tmp_path / command)
        told, _ = numbers(*words, *(["--film", "none", "--stills", 2] if command == "relight" else []))
        assert told["pictures"][0]["picture"] == os.fsdecode(odd)


def test_two_processes_do_not_write_to_one_folder(tiny, photos, tmp_path, refused):
    out = tmp_path / "out"
    words = ("mesh", "-m", tiny, photos / "0.png", "--size", 32, "-o", out)
    (out / ".sheet").mkdir(parents=True)
    with FileLock(out / ".sheet" / LOCK_FILE):
        assert "is being written by another process" in refused(*words)
    assert run(*words) == 0 and [entry.name for entry in out.iterdir()] == ["0"]
    (tmp_path / "link").symlink_to("nothing")
    assert "a file or a broken link: choose another place" in refused(*words[:-1], tmp_path / "link")
    assert "a file or a broken link" in refused("embed", *words[1:3], "-d", photos, "-o", out / "0/0.glb/x")


def test_results_among_the_images_are_no_images(tiny, tmp_path, numbers, refused):
    words = ("decompose", "-m", tiny, noise(tmp_path / "in", 3), "-o")
    for _ in range(2):
        told, _ = numbers(*words, tmp_path / "in" / "out", "--force")
        assert len(told["pictures"]) == 3
    assert "is the folder of the images" in refused(*words, tmp_path / "in")


def test_the_whole_photograph_is_written_unless_the_frame_is_asked_for(tiny, photos, tmp_path):
    wide = Image.new("RGB", (160, 96), (200, 30, 30))
    wide.paste(Image.open(photos / "0.png"), (48, 16))
    wide.save(tmp_path / "wide.png")
    words = ["relight", "-m", tiny, tmp_path / "wide.png", "--stills", 2, "--frames", 2, "--film", "mp4"]
    assert run(*words, "-o", tmp_path / "whole") == 0
    still = np.asarray(Image.open(tmp_path / "whole" / "wide" / "still-01.png").convert("RGB"))
    assert still.shape == (96, 160, 3) and (still[:, :2] == (200, 30, 30)).all()
    assert np.abs(still.astype(int) - np.asarray(wide)).max() > 20
    assert run(*words, "-o", tmp_path / "frame", "--only-frame", "--size", 48) == 0
    with Image.open(tmp_path / "frame" / "wide" / "still-01.png") as frame:
        assert frame.size == (48, 48)


def test_one_image_is_written_as_a_single_file(tiny, photos, tmp_path, refused):
    """The file has the bytes or pixels of the folder's: last still, film, panel or mesh."""
    one, fast = photos / "0.png", ["-m", tiny, "--size", 32, "--fit-steps", 0]
    words = ["relight", one, *fast, "--reach", 50, "--frames", 4]
    assert run(*words, "-o", tmp_path / "all") == 0
    made = tmp_path / "all" / "0"
    for name in ("lit.png", "lit.jpg", "lit.gif", "back.png"):
        more = ["--reach", -50] if name == "back.png" else []
        assert run(*words, *more, "-o", tmp_path / "single" / name) == 0
    stills = [np.asarray(Image.open(made / f"still-{number:02d}.png")) for number in (1, 7)]
    single = {file.name: file for file in (tmp_path / "single").iterdir()}
    assert len(single) == 4  # and nothing beside them
    for name, still in (("lit.png", stills[1]), ("back.png", stills[0])):
        np.testing.assert_array_equal(np.asarray(Image.open(single[name])), still)
    with Image.open(single["lit.jpg"]) as lit:
        assert lit.format == "JPEG" and lit.mode == "RGB"
    assert single["lit.gif"].read_bytes() == (made / "film.gif").read_bytes()
    assert run("mesh", one, *fast, "-o", tmp_path / "one.glb") == 0
    assert (tmp_path / "one.glb").read_bytes()[:4] == b"glTF"
    assert run("decompose", one, *fast, "-o", tmp_path / "panel.png") == 0
    before = (tmp_path / "panel.png").read_bytes()
    again = ("decompose", one, *fast, "-o", tmp_path / "panel.png")
    assert "exists already" in refused(*again)
    assert run(*again, "--resume") == 0 and (tmp_path / "panel.png").read_bytes() == before
    assert "no single .mp4 is made here, but .png" in refused(*again[:-1], tmp_path / "x.mp4")
    assert "there are 6 images" in refused("mesh", photos, *fast, "-o", tmp_path / "x.glb")
    assert "add --factor" in refused("swap", one, *fast, "--from", one, "-o", tmp_path / "x.png")
    assert not list(tmp_path.glob("x.*"))


@pytest.mark.parametrize(("command", "file"), [("rotate", "strip.png"), ("mesh", "0.glb")])
def test_without_out_the_folder_is_named_after_the_command(
    tiny, photos, tmp_path, monkeypatch, refused, command, file
):
    monkeypatch.chdir(tmp_path)
    words = [command, photos / "0.png", "-m", tiny, "--size", 32, "--fit-steps", 0]
    words += ["--film", "none"] * (command == "rotate")
    assert run(*words) == 0 and (tmp_path / f"derender-{command}" / "0" / file).exists()
    assert f"derender-{command}/0 exists already" in refused(*words)


def test_bad_questions_about_pictures(tiny, photos, tmp_path, refused):
    one, out = photos / "0.png", tmp_path / "out"
    given = ("-m", tiny, one, "-o", out)
    swap = ("swap", *given, "--from", photos / "1.png", "--factor")
    assert "unknown factor 'albdo'; did you mean 'albedo'" in refused(*swap, "albdo")
    assert "none.png does not exist" in refused("relight", *given, "--like", tmp_path / "none.png")
    assert "holds no images" in refused("rotate", "-m", tiny, tmp_path, "-o", out)
    assert "reach must lie between" in refused("rotate", *given, "--reach", "120")
    assert "reach must not be 0" in refused("relight", *given, "--reach", "0")
    small = refused("relight", *given, "--size", "16")
    assert "size 16 is below the model's: give --size 32 or more" in small
    assert "unknown detail 'foto'; did you mean 'photo'" in refused("mesh", *given, "--detail", "foto")
    assert "unknown format 'gbl'; did you mean 'glb'" in refused("mesh", *given, "--format", "gbl")
    assert "unknown kind of film 'avi'" in refused("rotate", *given, "--film", "avi")
    assert not out.exists()
    assert "is the image itself" in refused("decompose", "-m", tiny, one, "-o", one, "--force")
    (notes := tmp_path / "notes").touch()
    assert "is a file: name a folder to write to" in refused("mesh", "-m", tiny, one, "-o", notes)
    (out / "0").mkdir(parents=True)
    assert "exists already: choose another --out, or add --force" in refused("mesh", *given)
    assert list((out / "0").iterdir()) == []


@pytest.mark.skipif(os.name != "posix" or os.geteuid() == 0, reason="needs a user whom permissions bind")
def test_a_folder_that_may_not_be_written(tiny, photos, tmp_path, refused):
    (closed := tmp_path / "locked").mkdir(mode=0o500)
    assert "permission denied" in refused("mesh", "-m", tiny, photos / "0.png", "-o", closed / "out")


def test_bad_searches(table, tiny, photos, tmp_path, refused):
    like = ("search", "-f", table, "--like")
    assert "unknown factor 'shape'" in refused(*like, "0.png", "--factor", "shape")
    assert "did you mean 'geometry'" in refused(*like, "0.png", "--factor", "geometri")
    assert "unknown metric 'l2'" in refused(*like, "0.png", "--metric", "l2")
    assert "has no row '9.png'" in refused(*like, "9.png")
    assert "to search with an image, add a model" in refused(*like, photos / "0.png")
    assert "no.png is no image file" in refused(*like, tmp_path / "no.png", "--model", tiny)
    assert "must end in .png" in refused(*like, "0.png", "--out", tmp_path / "sheet.gif")
    taken = tmp_path / "taken.png"
    taken.write_bytes(b"mine")
    assert "exists already" in refused(*like, "0.png", "--out", taken)
    other = Derenderer.from_preset("small", seed=1, image_size=SIZE, width=4, light_width=4)
    saved = other.save(tmp_path / "other")
    assert "was made by another model" in refused(*like, photos / "0.png", "--model", saved)
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    Image.new("RGB", (8, 8)).save(elsewhere / "x.png")
    complaint = refused(*like, "0.png", "--out", tmp_path / "s.png", "--data", elsewhere)
    assert "holds none of the images found" in complaint and not (tmp_path / "s.png").exists()


def test_pictures_unlike_what_the_model_was_validated_on_are_named(tiny, photos, tmp_path, capsys):
    """Errors kept with a copy of the model decide which images are named; they never stop a command."""
    known = Path(shutil.copytree(tiny, tmp_path / "known"))
    one, two = photos / "0.png", photos / "1.png"
    words = ["--size", "32", "--film", "none", "--stills", "2"]
    for name, *rest in (["relight", *words], ["mesh", "--size", "32"], ["decompose"]):
        assert run(name, "-m", tiny, one, "-o", tmp_path / f"no-{name}", *rest) == 0
        printed = capsys.readouterr().err
        assert "reconstructed worse" not in printed and "not in the crop" not in printed
    write_errors(known, HeldOutErrors(pictures=50, quantiles=list(np.linspace(0, 0.001, 101))))
    told = tmp_path / "told.json"
    words = ["--size", "32", "--from", two, "--factor", "light", "--json", told]
    assert run("swap", "-m", known, one, "-o", tmp_path / "swapped", *words) == 0
    printed = capsys.readouterr().err
    assert "2 of 2 images are reconstructed worse than 99 % of those this model was validated on" in printed
    assert f"{one} is one" in printed
    assert json.loads(told.read_text())["reconstruction_percentile"] == {str(one): 100, str(two): 100}
    write_errors(known, HeldOutErrors(pictures=50, quantiles=list(np.linspace(0, 2, 101))))
    assert run("mesh", "-m", known, one, "-o", tmp_path / "usual", "--size", "32") == 0
    printed = capsys.readouterr().err
    assert "out-of-distribution" not in printed
    assert re.search(r"reconstructed worse than \d\d? % of the images this model was validated on", printed)
    (known / ERRORS_FILE).write_text("{")
    assert run("mesh", "-m", known, one, "-o", tmp_path / "damaged", "--size", "32") == 0
    assert "cannot find out-of-distribution images" in capsys.readouterr().err
