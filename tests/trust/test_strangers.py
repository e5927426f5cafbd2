"""Files of a run or a model that a stranger wrote: refused in one sentence, in little time and memory."""

import io
import json
import os
import resource
import shutil
import time
import tracemalloc
import zipfile
from contextlib import contextmanager
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import torch
from tests.conftest import made_smallest
from tests.trust.hostile_files import encoded, png_that_says, smooth

import derender
from derender.cli import main
from derender.cli.console import show_scores
from derender.data import read_images
from derender.data.source import ZipSource
from derender.data.synthetic.settings import FaceSettings, named_settings
from derender.evaluation.angles import read_columns
from derender.evaluation.identity import read_pairs
from derender.evaluation.score_table import Column, Row, ScoreTable
from derender.interpretation.probe import load_probe
from derender.learn.plan import read_plan
from derender.networks.unsup3d import read_checkpoint
from derender.objectives.perceptual import _read_weights
from derender.objectives.self_features import load_self_features
from derender.report.run import run_page
from derender.storage.atomic import check_seal
from derender.storage.bounded import DEEPEST, MOST_VALUES, parse_json, parse_yaml, read_bounded
from derender.storage.folder import read_split
from derender.storage.sharing import Shareable, _errors_in_words
from derender.storage.tensors import read_tensors, reads_safely
from derender.training import resolve
from derender.training.checkpoint import TrainState, load_checkpoint, save_checkpoint
from derender.training.config import to_yaml
from derender.training.held_out_errors import read_errors
from derender.training.run_folder import RunFolder, drop_metrics_after, read_config_tree, read_metrics

SECONDS, MEGABYTES = 5.0, 300
DEEP = "[" * 100_000
BOMB = "a: &a [x, x, x, x, x, x, x, x, x]\n" + "".join(
    f"{name}: &{name} [{', '.join([f'*{before}'] * 9)}]\n"
    for before, name in zip("abcdefghi", "bcdefghij", strict=True)
)
YAML_ATTACKS = {
    "billion laughs": BOMB,
    "of mappings": BOMB.replace("[", "{").replace("]", "}").replace("x, x, x, x, x, x, x, x, x", "x: 1")
    .replace("{*", "{<<: [*").replace("}\n", "]}\n").replace("x: 1]}", "x: 1}"),
    "chain": "a0: &a0 [1]\n" + "".join(f"a{n + 1}: &a{n + 1} [*a{n}]\n" for n in range(2_000)),
    "many": "a: &a [" + "1," * 2_000 + "]\nb: [" + "*a," * 100 + "]",
    "in itself": "&a [*a]",
    "own key": "&a {*a : 1}",
    "merged with itself": "&a {<<: *a, b: 1}",
    "deep": DEEP,
    "deep mappings": "{a: " * 50_000,
    "long": "a: " + "1:" * 100_000 + "1",
    "large": "a: " + "b" * 10_000_000,
    "no number": 'a: "\\UFFFFFFFF"',
}  # fmt: skip


@contextmanager
def cheaply():
    """Fails if the block takes much time, or the process more memory than before."""
    before, began = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss, time.process_time()
    soft, hard = resource.getrlimit(resource.RLIMIT_AS)
    used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (used + (2 << 30), hard))  # reading it all fails, no machine does
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_AS, (soft, hard))
    assert time.process_time() - began < SECONDS
    assert (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) / 1024 < MEGABYTES


def sparse(file: Path, gigabytes: int = 8) -> Path:
    """A file of so many zeros that takes no room on disk."""
    file.unlink(missing_ok=True)
    with file.open("wb") as stream:
        os.truncate(stream.fileno(), gigabytes << 30)
    return file


@pytest.fixture(scope="module")
def whole_run(tmp_path_factory) -> Path:
    """A run folder with every file that readers look at."""
    folder, smallest = tmp_path_factory.mktemp("whole") / "run", made_smallest()
    smallest.save(folder / "model")
    (folder / "samples").mkdir()
    config = resolve("small", ["image_size=32", "width=4", "light_width=4"])
    (folder / "config.yaml").write_text(to_yaml(config))
    (folder / "environment.json").write_text('{"python": "3.12", "data": {"pictures": 8}}')
    (folder / "metrics.jsonl").write_text('{"kind": "train", "images": 8, "seconds": 1.5, "loss": NaN}\n')
    optimiser = torch.optim.Adam(smallest.parameters())
    save_checkpoint(folder / "checkpoints" / "last", smallest, optimiser, TrainState(images=8))
    run_page(folder)
    return folder


@pytest.fixture
def run(tmp_path, whole_run) -> Path:
    return Path(shutil.copytree(whole_run, tmp_path / "run"))


@pytest.mark.parametrize("attack", YAML_ATTACKS)
def test_yaml_that_unfolds_or_nests_without_end_is_refused_before_it_is_built(tmp_path, attack):
    text = YAML_ATTACKS[attack]
    (tmp_path / "plan.yaml").write_text(text)
    (tmp_path / "config.yaml").write_text(text)
    readers = {
        "parse": partial(parse_yaml, text), "plan": partial(read_plan, tmp_path / "plan.yaml"),
        "run": partial(read_config_tree, tmp_path), "--set": partial(resolve, "small", [f"betas={text}"]),
        "synth": partial(named_settings, FaceSettings, overrides=[f"light={text}"]),
    }  # fmt: skip
    for read in readers.values():
        with cheaply(), pytest.raises(ValueError):
            read()
    given = ["--data", str(tmp_path), "--out", str(tmp_path / "out")]
    with cheaply():
        assert main(["train", *given, "--config", str(tmp_path / "config.yaml")]) == 2


def test_plain_anchors_are_read(tmp_path):
    text = "a: &a {x: [1, .5]}\nb: *a\nc: {<<: *a, y: 2001-01-01}\n"
    assert parse_yaml(text)["c"] == {"x": [1, 0.5], "y": parse_yaml("2001-01-01")}
    assert parse_yaml("[" * DEEPEST + "]" * DEEPEST) and parse_yaml("") is None
    assert len(parse_yaml("[" + "a, " * (MOST_VALUES - 2) + "]")) == MOST_VALUES - 2


JSON_ATTACKS = (
    DEEP, '{"a":' * 100_000, "[]", "7", "null", '{"format": Infinity}', '{"format": 1e999}', "1" * 5_000,
    '{"format": [1]}', '{"kind": "train", "images": Infinity}', '{"kind": "train", "images": [8]}',
    '{"kind": ["train"], "images": 8}', '{"kind": "train"}', '{"kind": "train", "images": 8, "seconds": "x"}',
    '{"format": 1, "shares": [Infinity, 0, 0], "seed": 0}', '{"format": 1, "shares": [1, 0, 0], "seed": NaN}',
    '{"format": 1, "shares": [1, 0, 0], "seed": 1e400}', '{"crc32": {"a": [Infinity, 1]}}',
    '{"state": {"images": 1e999}, "format": 1}', '{"pictures": 1e999, "quantiles": [' + "1," * 100 + "1]}",
    '{"packages": [[[' + "[" * 150 + "]" * 150 + "]]]}", '{"packages": {"torch": 1}, "data": [1]}', "\0",
)  # fmt: skip
JSON_FILES = {
    "model/config.json": lambda run, model: derender.load(run),
    "model/held_out_errors.json": lambda run, model: read_errors(run / "model"),
    "model/split.json": lambda run, model: read_split(run / "model"),
    "checkpoints/last/state.json": lambda run, model: load_checkpoint(run / "checkpoints/last", model, None),
    "checkpoints/last/checksums.json": lambda run, model: check_seal(run / "checkpoints/last"),
    "metrics.jsonl": lambda run, model: (run_page(run), drop_metrics_after(RunFolder(run), 8)),
    "environment.json": lambda run, model: run_page(run),
    "model/probe.json": lambda run, model: load_probe(run / "model"),
    "config.yaml": lambda run, model: run_page(run),
}


@pytest.mark.parametrize("name", JSON_FILES)
def test_json_of_a_stranger_is_one_line_of_error_or_read_and_takes_no_memory(name, run, smallest):
    file, read = run / name, partial(JSON_FILES[name], run, smallest)
    (run / "model" / "probe.safetensors").write_bytes(b"")
    refused = 0
    for attack in JSON_ATTACKS:
        file.write_text(attack + "\n")
        with cheaply():
            try:
                read()
            except ValueError as error:
                refused += 1
                assert "\n" not in str(error) and len(str(error)) < 500
    assert refused == len(JSON_ATTACKS) or name in ("metrics.jsonl", "environment.json")
    assert refused > 5 or name == "environment.json"
    sparse(file)
    with cheaply():
        if name == "environment.json":
            read()
        else:
            with pytest.raises(ValueError, match=r"larger than|checksums.json cannot be read|is damaged"):
                read()
    file.unlink()
    os.mkfifo(file)
    with cheaply():
        try:
            read()
        except (ValueError, FileNotFoundError) as error:
            assert "not a regular file" in str(error) or "no " in str(error) or "cannot" in str(error)


@pytest.mark.parametrize("given", [64, 0, -1, 1e308, True, [16], 2**70, "NaN"])
def test_sizes_that_a_model_cannot_have_grown_from_are_named(given, run):
    file = run / "model" / "config.json"
    config = json.loads(file.read_text())
    config["settings"]["network"]["grown_from"] = given
    file.write_text(json.dumps(config))
    with cheaply(), pytest.raises(ValueError, match=r"is damaged \(network.*: .*\): copy or train"):
        derender.load(run)


def test_metrics_name_the_line_and_forgive_one_cut_off_at_the_end(run):
    with (run / "metrics.jsonl").open("a") as file:
        file.write('{"kind": "train", "ima')
    (row,) = read_metrics(run)
    assert row["images"] == 8
    with (run / "metrics.jsonl").open("a") as file:
        file.write("\n[1]\n")
    with pytest.raises(ValueError, match=r"metrics\.jsonl is damaged \(line 2: .*: delete that line"):
        read_metrics(run)
    images = ["--data", str(run), "--device", "cpu"]
    assert main(["report", str(run), *images, "--force"]) == 2


def test_cards_and_errors_beside_a_model_are_bounded(run, tmp_path):
    assert _errors_in_words(DEEP) == _errors_in_words('{"pictures": Infinity, "quantiles": [1]}') == ""
    loaded = derender.load(run)
    sparse(run / "model" / "README.md")
    with cheaply(), pytest.raises(ValueError, match="larger than"):
        Shareable.save_pretrained(loaded, tmp_path / "copy")


def test_weights_larger_than_their_network_are_refused_unread(run, smallest):
    weights = run / "model" / "model.safetensors"
    head = json.dumps({"a": {"dtype": "F32", "shape": [10 << 30], "data_offsets": [0, 40 << 30]}}).encode()
    sparse(weights, 40)
    with weights.open("r+b") as file:
        file.write(len(head).to_bytes(8, "little") + head)
        file.truncate(8 + len(head) + (40 << 30))
    with cheaply(), pytest.raises(ValueError, match=r"is damaged .*larger than"):
        derender.load(run)
    for read in (read_tensors, load_self_features):
        with cheaply(), pytest.raises(ValueError, match="larger than"):
            read(weights)
    last = run / "checkpoints" / "last"
    for name in ("model.safetensors", "optimiser.safetensors"):
        sparse(last / name, 40)
        (last / "checksums.json").write_text(json.dumps({"crc32": {"state.json": [1, 1]}}))
        with cheaply(), pytest.raises(ValueError, match="is damaged"):
            load_checkpoint(last, smallest, torch.optim.Adam(smallest.parameters()))


def test_only_regular_files_are_read(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    for path in (tmp_path / "pipe", Path("/dev/zero"), tmp_path):
        with pytest.raises(ValueError, match="not a regular file"):
            read_bounded(path)
    with pytest.raises(ValueError):
        parse_json("NaN", int)


def test_tables_of_pairs_and_angles_are_bounded(tmp_path):
    columns = partial(read_columns, names=("yaw",))
    readers = {"pairs.txt": read_pairs, "a.npz": columns, "a.csv": columns, "a.parquet": columns}
    for name, read in readers.items():
        file = tmp_path / name
        for damage in (
            sparse,
            os.mkfifo,
            lambda at: at.symlink_to("/dev/zero"),
            lambda at: at.write_bytes(b"PK\xff"),
        ):
            file.unlink(missing_ok=True)
            damage(file)
            with cheaply(), pytest.raises(ValueError, match=f"{name} cannot be read as"):
                read(file)
    for numbers, content in ((1 << 40, 1_000), (1 << 27, 300 << 20)):
        head = io.BytesIO()
        described = {"descr": "<f8", "fortran_order": False, "shape": (numbers,)}
        np.lib.format.write_array_header_1_0(head, described)
        with zipfile.ZipFile(tmp_path / "a.npz", "w", zipfile.ZIP_DEFLATED) as archive:
            archive.writestr("yaw.npy", head.getvalue() + bytes(content))
        with cheaply(), pytest.raises(ValueError, match=r"a\.npz cannot be read as"):
            columns(tmp_path / "a.npz")


PLAIN = torch.ones(4, 3, 4, 4)
PICKLED = {
    "stride 0": lambda: torch.ones(1).expand(1 << 20, 1 << 20),
    "meta": lambda: torch.empty(1 << 20, 1 << 20, device="meta"),
    "sparse": lambda: torch.sparse_coo_tensor([[0]], [1.0], (1 << 40,)),
    "quantised": lambda: torch.quantize_per_tensor(PLAIN, 0.1, 0, torch.qint8),
    "complex": lambda: PLAIN.to(torch.complex64),
}


@pytest.mark.skipif(not reads_safely(), reason="this PyTorch is not trusted with pickles")
@pytest.mark.filterwarnings("ignore::UserWarning", "ignore::DeprecationWarning")
@pytest.mark.parametrize("kind", PICKLED)
def test_tensors_of_a_pickle_that_claim_more_than_they_hold_are_refused(tmp_path, kind):
    file = tmp_path / "theirs.pth"
    content = {net: {"a": PLAIN, "b": PICKLED[kind]()} for net in ("netD", "netA", "netL", "netV")}
    torch.save(content, file)
    with cheaply():
        assert main(["import", str(file), "--out", str(tmp_path / "model")]) == 2
        with pytest.raises(ValueError, match=r"no dense tensor|more numbers than are stored|damaged"):
            read_checkpoint(file)
    torch.save(content["netD"], tmp_path / "vgg.pth")
    with cheaply(), pytest.raises(ValueError, match=r"no dense tensor|more numbers than are stored|damaged"):
        _read_weights(tmp_path / "vgg.pth")


@pytest.mark.skipif(not reads_safely(), reason="this PyTorch is not trusted with pickles")
def test_pickles_that_are_pipes_huge_or_unpack_to_more_are_not_opened(tmp_path):
    os.mkfifo(tmp_path / "pipe.pth")
    sparse(tmp_path / "huge.pth", 40)
    torch.save({"netD": {"a": torch.zeros(5_000_000)}}, tmp_path / "plain.pth")
    with (
        zipfile.ZipFile(tmp_path / "plain.pth") as plain,
        zipfile.ZipFile(tmp_path / "packed.pth", "w", zipfile.ZIP_DEFLATED) as packed,
    ):
        for name in plain.namelist():
            packed.writestr(name, plain.read(name))
    reasons = {"pipe": "not a regular file", "huge": "larger than", "packed": "unpacks to more bytes"}
    for name, reason in reasons.items():
        with cheaply(), pytest.raises(ValueError, match=reason):
            read_checkpoint(tmp_path / f"{name}.pth")
        with cheaply(), pytest.raises((ValueError, FileNotFoundError), match=f"{reason}|no file"):
            _read_weights(tmp_path / f"{name}.pth")


def test_samples_that_are_pipes_devices_or_giants_do_not_hold_up_a_report(run):
    samples = run / "samples"
    os.mkfifo(samples / "000000001.png")
    (samples / "000000002.png").symlink_to("/dev/zero")
    (samples / "000000003.png").write_bytes(png_that_says(13_000, 13_000))
    (samples / "000000004.png").write_bytes(encoded(smooth(1)))
    with cheaply():
        text = run_page(run).html()
    assert text.count("not a regular file") == 2 and "more than 20 million pixels" in text
    assert text.count("data:image/jpeg") == 1


def test_members_that_unpack_to_much_are_judged_by_their_header(tmp_path):
    """And those whose header stands at the end one at a time; each would take 66 MB."""
    zeros, whole = bytes(66 << 20), encoded(smooth(1))
    with zipfile.ZipFile(tmp_path / "a.zip", "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("good.png", whole)
        for number in range(2):
            archive.writestr(f"zeros {number}.png", zeros)
        archive.writestr("long.png", whole + zeros)
    tracemalloc.start()
    try:
        images = read_images(tmp_path / "a.zip", 16)
        assert tracemalloc.get_traced_memory()[1] < 50 << 20
    finally:
        tracemalloc.stop()
    assert images.files == ("good.png",)
    reasons = {row.file: row.reason for row in images.skipped}
    assert len(reasons) == 3 and reasons["long.png"] == "66 MiB of 48 x 40 pixels"


@pytest.mark.parametrize("packing", [zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA])
def test_members_in_whose_packing_few_bytes_are_gigabytes_are_not_unpacked(tmp_path, packing):
    with zipfile.ZipFile(tmp_path / "a.zip", "w", packing) as archive:
        archive.writestr("good.png", encoded(smooth(1)), zipfile.ZIP_DEFLATED)
        archive.writestr("liar.png", bytes(50 << 20) + encoded(smooth(1)))
        archive.infolist()[1].file_size = 100_000
    tracemalloc.start()
    try:
        images = read_images(tmp_path / "a.zip", 16)
        assert tracemalloc.get_traced_memory()[1] < 20 << 20
    finally:
        tracemalloc.stop()
    assert images.files == ("good.png",) and len(images.skipped) == 1


def test_large_members_are_read_one_at_a_time(tmp_path, monkeypatch):
    with zipfile.ZipFile(tmp_path / "a.zip", "w", zipfile.ZIP_DEFLATED) as archive:
        for number in range(40):
            archive.writestr(f"{number}.tif", encoded(smooth(number), "TIFF") + bytes(200_000))
    at_once, most, read = 0, 0, ZipSource.read

    def counted(source: ZipSource, file: str) -> bytes:
        nonlocal at_once, most
        at_once += 1
        most = max(most, at_once)
        time.sleep(0.01)
        content = read(source, file)
        at_once -= 1
        return content

    monkeypatch.setattr(ZipSource, "read", counted)
    monkeypatch.setattr("derender.data.stream.LARGE_BYTES", 100_000)
    assert len(read_images(tmp_path / "a.zip", 16, workers=2)) == 40 and most == 1


def test_a_table_of_results_cannot_steer_the_terminal(capsys):
    evil = "\x1b]0;owned\x07\x9b2J\r[bold]x[/bold]"
    shown = ScoreTable(f"nearest to {evil}", evil, (Column(evil),), [Row(evil, (evil,))])
    show_scores(shown, None)
    message = capsys.readouterr().out
    assert not {"\x1b", "\x07", "\x9b", "\r"} & set(message)
    assert message.count("[bold]x[/bold]") == 5 and message.count("\\x1b]0;owned") == 5
