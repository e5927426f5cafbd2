"""`derender align`: every face of a folder upright where it belongs, and the way back into the photograph."""

import csv
import json
import os
import sys

import numpy as np
import pytest
from PIL import Image

import derender
from derender.cli import main
from derender.data import read_photo
from derender.data.synthetic import faces
from derender.data.synthetic.settings import FaceSettings
from derender.photo import Face, Frame, find_faces
from derender.photo.align import AFFINE, COLUMNS, _write
from derender.photo.faces import BOTH_FAMILIES, TEMPLATES, UTKFACE, YAW_CROP, frame_of, yaw_deg
from derender.report.viewer.images import rendered_examples

MODULE = sys.modules["derender.photo.align"]  # the package has the function by that name


def head(number: int, size: int) -> Image.Image:
    """A rendered head (nobody's)."""
    tile = rendered_examples("rendered-faces-64", 64)[number].picture
    return Image.fromarray(tile).resize((size, size), Image.Resampling.LANCZOS)


def scene(*heads: tuple[int, int, tuple[int, int], float]) -> Image.Image:
    """A photograph with heads (number, size, place, roll) in it."""
    noise = np.random.default_rng(1).integers(0, 255, (6, 8, 3), dtype=np.uint8)
    photo = Image.fromarray(noise).resize((640, 480), Image.Resampling.BICUBIC)
    for number, size, at, roll in heads:
        turned = head(number, size).convert("RGBA").rotate(-roll, Image.Resampling.BICUBIC, expand=True)
        photo.paste(turned, at, turned)
    return photo


@pytest.fixture(scope="module")
def photos(tmp_path_factory):
    folder = tmp_path_factory.mktemp("photos")
    (folder / "two").mkdir()
    scene((0, 220, (380, 30), 15.0), (1, 150, (60, 200), -20.0)).save(folder / "two" / "pair.png")
    scene().save(folder / "none.png")
    (folder / "broken.jpg").write_bytes(b"no image")
    return folder


@pytest.fixture(scope="module")
def aligned(photos, tmp_path_factory):
    out = tmp_path_factory.mktemp("out") / "aligned"
    return derender.align(photos, out, size=128, model="rendered-faces-128"), out


def test_every_face_lies_where_the_model_has_it(aligned):
    done, out = aligned
    assert done.counts["faces"] == 2 and done.counts["photographs"] == 3
    assert done.counts["without_face"] == done.counts["unreadable"] == 1
    for name in ("two/pair.png", "two/pair-2.png"):
        large = Image.open(out / name).resize((256, 256), Image.Resampling.BICUBIC)
        (face,) = find_faces(np.asarray(large))
        assert np.abs(face.points / 256 - BOTH_FAMILIES)[[0, 1, 3, 4]].max() < 0.04  # the nose turns
    reasons = {row["photo"]: row["rejected"] for row in done.rows if not row["file"]}
    assert reasons["none.png"] == "no face found" and "known format" in reasons["broken.jpg"]


def test_heads_of_either_family_keep_nearly_their_training_frame():
    made = faces.generate(5, 160, seed=3, settings=FaceSettings(pictures_per_identity=1)).images
    for images in (made.transpose(0, 2, 3, 1), [np.asarray(head(number, 160)) for number in range(5)]):
        template = TEMPLATES["rendered-faces-64"]
        results = [frame_of(face, template) for one in images for face in find_faces(one)]
        assert len(results) >= 4 and abs(np.median([one.side for one in results]) / 160 - 1) < 0.08


def test_the_transform_leads_back_into_the_photograph(aligned, photos):
    _, out = aligned
    with (out / "boxes.csv").open(newline="") as file:
        row = next(row for row in csv.DictReader(file) if row["file"] == "two/pair.png")
    xx, xy, x0, yx, yy, y0 = (float(row[name]) for name in AFFINE)
    photo = np.asarray(Image.open(photos / row["photo"])).astype(float)
    crop = np.asarray(Image.open(out / row["file"])).astype(float)
    v, u = np.mgrid[20:108:11, 20:108:11] + 0.5
    columns, rows = (xx * u + xy * v + x0).astype(int), (yx * u + yy * v + y0).astype(int)
    assert np.abs(photo[rows, columns] - crop[v.astype(int), u.astype(int)]).mean() < 6
    assert abs(float(row["roll_deg"]) - 15) < 6
    place = {name: float(row[name]) for name in ("x", "y", "side", "roll_deg")}
    assert np.allclose(Frame(**place).corners()[0], (x0, y0), atol=1e-2)


def test_a_stopped_run_goes_on_and_a_finished_one_is_kept(photos, tmp_path, capsys):
    stops = iter((None, KeyboardInterrupt))

    def stop(done, total):
        if (error := next(stops)) is not None:
            raise error

    with pytest.raises(KeyboardInterrupt, match="the same command continues"):
        derender.align(photos, tmp_path / "a", progress=stop)
    with pytest.raises(ValueError, match="not known to be of faces"):
        derender.align(photos, tmp_path / "b", model="cars-64")
    with pytest.raises(ValueError, match="move it out"):
        derender.align(photos, photos / "crops")
    with pytest.raises(ValueError, match="other options"):
        derender.align(photos, tmp_path / "a", size=64)
    finished = derender.align(photos, tmp_path / "a")
    assert finished.resumed == 1
    assert finished.rows == derender.align(photos, tmp_path / "b").rows
    words = ["align", str(photos), "--out", str(tmp_path / "a"), "--largest"]
    assert main(words) == 2 and "exists already" in capsys.readouterr().err
    assert main([*words, "--force"]) == 0
    assert "1 face in 3 photographs; no face in 1, 1 rejected" in capsys.readouterr().out
    assert not (tmp_path / "a" / "two" / "pair-2.png").exists()
    assert main([*words, "--force", "--keep"]) == 0
    assert "1 face in 3 photographs; no face in 1, 1 rejected" in capsys.readouterr().out
    kept = tmp_path / "a" / "none.png"
    assert read_photo(kept).shape == (256, 256, 3)
    assert "\nnone.png,none.png,no face found,,,,,,320.0,240.0,480.0,0.0,1.875," in (
        tmp_path / "a" / "boxes.csv"
    ).read_text().replace("\r", "")
    assert main([*words, "--force"]) == 0 and not kept.exists()
    (tmp_path / "mine.png").write_bytes(b"kept")
    text = (tmp_path / "a" / "boxes.csv").read_text().replace("two/pair.png,", "../mine.png,", 1)
    (tmp_path / "a" / "boxes.csv").write_text(text)
    assert main([*words, "--force"]) == 0 and (tmp_path / "mine.png").exists()
    (tmp_path / "a" / "boxes.csv").write_text("a,b\n1,2\n")
    assert main([*words, "--force"]) == 2 and "no table of derender align" in capsys.readouterr().err


@pytest.fixture
def two_faces(tmp_path, monkeypatch):
    """A folder of photographs in each of which two faces are found at once."""
    face = Face((8, 8, 56, 56), 64 * np.array(UTKFACE, np.float32), 1.0)
    monkeypatch.setattr(MODULE, "face_candidates", lambda _: [face, face])
    for shade, name in enumerate(("a-2.png", "a.jpg", "a.png", "b/A.png", "two\u2028lines.png")):
        (tmp_path / "photos" / name).parent.mkdir(parents=True, exist_ok=True)
        Image.new("RGB", (64, 64), (40 * shade,) * 3).save(tmp_path / "photos" / name)
    return tmp_path / "photos"


def test_no_crop_takes_the_place_of_another_or_of_a_photograph(two_faces, tmp_path):
    out = tmp_path / "out"
    rows = derender.align(two_faces, out, size=16).rows
    assert len({row["file"].casefold() for row in rows}) == len(rows) == 10
    for row in rows:
        with Image.open(out / row["file"]) as crop, Image.open(two_faces / row["photo"]) as photo:
            assert np.abs(np.asarray(crop)[8, 8] - np.asarray(photo.convert("RGB"), int)[8, 8]).max() < 3
    before = {file: file.read_bytes() for file in two_faces.rglob("*") if file.is_file()}
    for place in (two_faces, two_faces / "b"):
        for overwrite in (False, True):
            with pytest.raises(FileExistsError, match="holds other files: choose an empty or new folder"):
                derender.align(two_faces, place, size=16, overwrite=overwrite)
    assert before == {file: file.read_bytes() for file in two_faces.rglob("*") if file.is_file()}


def test_a_table_cut_off_anywhere_is_continued_to_the_same_one(two_faces, tmp_path, monkeypatch):
    out = tmp_path / "out"
    calls = []
    monkeypatch.setattr(MODULE, "_write", lambda *given: calls.append(given) or _write(*given))
    whole = derender.align(two_faces, out, size=16)
    table, plan = (out / "boxes.csv").read_bytes(), calls[0][2]
    begun = f"# {json.dumps(plan)}\n".encode()
    first = table.index(b"\n") + 1
    for end in range(first, len(table), 61):
        (out / "boxes.csv").unlink()
        (out / "boxes.csv.partial").write_bytes(begun + table[:end])
        assert derender.align(two_faces, out, size=16).rows == whole.rows


BEGUN = "# {}\n" + ",".join(COLUMNS) + "\n"
TABLES = {
    "empty": "", "deep": "# {" + "[" * 100_000, "long": f"{BEGUN}{'x' * 200_000}\n",
    "short row": f"{BEGUN}a,b\n", "binary": "\0",
}  # fmt: skip


@pytest.mark.parametrize("table", [*TABLES, "sparse", "pipe"])
def test_a_table_of_a_stranger_is_refused_in_one_line(two_faces, tmp_path, table, capsys):
    (tmp_path / "out").mkdir()
    file = tmp_path / "out" / "boxes.csv.partial"
    if table == "pipe":
        os.mkfifo(file)
    elif table == "sparse":
        file.touch()
        os.truncate(file, 8 << 30)
    else:
        file.write_text(TABLES[table])
    for force in ([], ["--force"]):
        assert main(["align", str(two_faces), "--out", str(tmp_path / "out"), *force]) == 2
        printed = capsys.readouterr().err.splitlines()[-1]
        assert "boxes.csv.partial is no table of derender align (" in printed and len(printed) < 400


@pytest.mark.parametrize("yaw", [-70, -40, 0, 40, 70])
def test_the_turn_of_a_head_is_told(yaw):
    """Of heads that are found, within 15 degrees."""
    view = {"yaw_deg": (yaw, yaw), "yaw_sd_deg": None}
    settings = FaceSettings.model_validate({"view": view, "pictures_per_identity": 1})
    heads = (head.transpose(1, 2, 0) for head in faces.generate(3, 160, 5, settings).images)
    places = [find_faces(np.pad(head, ((44, 44), (44, 44), (0, 0)), mode="edge")) for head in heads]
    turns = [face.yaw_deg for place in places for face in place]
    assert len(turns) >= 2 and np.abs(np.subtract(turns, yaw)).max() < 15


def test_a_mirrored_crop_is_turned_the_other_way():
    crop = np.random.default_rng(0).integers(0, 256, (3, YAW_CROP, YAW_CROP), dtype=np.uint8)
    turn = yaw_deg(crop)
    assert abs(turn) > 1 and yaw_deg(crop[:, :, ::-1].copy()) == pytest.approx(-turn, rel=1e-4)


def test_faces_lying_on_their_side_are_found():
    turned = np.rot90(np.asarray(scene((0, 220, (200, 100), 0.0)))).copy()
    (face,) = find_faces(turned)
    left, right = face.points[:2]
    assert abs(right[0] - left[0]) < 0.2 * abs(right[1] - left[1]) and right[1] < left[1]
    assert np.hypot(*(left - right)) == pytest.approx(220 * (UTKFACE[1][0] - UTKFACE[0][0]), rel=0.15)
