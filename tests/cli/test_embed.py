"""`derender embed` on folders and streams: what it says, what it leaves after Ctrl-C, and how it goes on."""

import json
from pathlib import Path

import numpy as np
import pytest
from tests.cli.conftest import run
from tests.data.conftest import encode, noise
from tests.data.stream.conftest import write_shard

from derender import Derenderer, FeatureTable
from derender.data import stream as decoding


@pytest.fixture(autouse=True)
def own_cache(tmp_path, monkeypatch):
    monkeypatch.setenv("DERENDER_CACHE", str(tmp_path / "cache"))
    monkeypatch.setattr(decoding, "CHUNK", 4)


def shards(folder: Path, count: int = 20) -> str:
    for number in range(2):
        members = {}
        for row in range(number * count // 2, (number + 1) * count // 2):
            members |= {f"{row}.png": encode(noise(row, 32, 32)), f"{row}.cls": str(row % 2)}
        write_shard(folder / f"s-{number}.tar", members)
    return str(folder / "s-{0..1}.tar")


def embed(model: Path, data: str, out: Path, *more: object) -> int:
    return run("embed", "--model", model, "--data", data, "--out", out, "--batch-size", 4, *more)


def test_shards_with_a_cut_one_among_them(tiny, tmp_path, capsys):
    data = shards(tmp_path / "set")
    last = tmp_path / "set" / "s-1.tar"
    last.write_bytes(last.read_bytes()[:-12_000])
    assert embed(tiny, data, tmp_path / "f.parquet", "--json", tmp_path / "told.json") == 0
    printed = capsys.readouterr()
    table = FeatureTable.read(tmp_path / "f.parquet")
    told = json.loads((tmp_path / "told.json").read_text())
    assert told["rows"] == len(table) < 20 and told["skipped"] == 1 and told["labels"] == ["class"]
    assert f"{len(table)} images from {data} (webdataset), 1 skipped" in printed.err
    assert "skipped s-1.tar: damaged or cut short, what comes before counts" in printed.err
    assert "rows in" in printed.out


def test_ctrl_c_leaves_only_what_the_next_run_goes_on_with(tiny, tmp_path, capsys, monkeypatch):
    data, out = shards(tmp_path / "set"), tmp_path / "f.parquet"
    assert embed(tiny, data, tmp_path / "whole.parquet") == 0
    real, calls = Derenderer.embed, []

    def interrupted(self, images):
        calls.append(len(images))
        if len(calls) == 3:
            raise KeyboardInterrupt
        return real(self, images)

    monkeypatch.setattr(Derenderer, "embed", interrupted)
    before = set(tmp_path.iterdir())
    capsys.readouterr()
    assert embed(tiny, data, out) == 130
    kept = f"8 rows are kept in {out}.partial: the same command continues from there"
    assert capsys.readouterr().err.strip().endswith(kept)
    assert set(tmp_path.iterdir()) - before == {tmp_path / "f.parquet.partial"}
    assert embed(tiny, data, out, "--limit", "12") == 2
    otherwise = "holds an unfinished table that was made otherwise (differs in pictures)"
    assert otherwise in capsys.readouterr().err
    assert embed(tiny, data, out) == 0
    assert "8 of them from the run before" in capsys.readouterr().err
    assert sum(calls) == 24, "twenty images, and the four that were interrupted"
    whole, resumed = FeatureTable.read(tmp_path / "whole.parquet"), FeatureTable.read(out)
    assert whole.files == resumed.files and whole.origin == resumed.origin
    for name, values in whole.factors.items():
        np.testing.assert_array_equal(resumed.factors[name], values)
    assert set(tmp_path.iterdir()) - before == {out}


def test_what_cannot_be_read_is_one_line(tiny, tmp_path, refused, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("HF_HUB_OFFLINE", "1")
    import huggingface_hub

    def offline(self, *_, **__):
        raise huggingface_hub.errors.OfflineModeIsEnabled("offline mode is enabled")

    monkeypatch.setattr(huggingface_hub.HfApi, "dataset_info", offline)
    for data, words in (
        ("someone/faces", "someone/faces does not exist here; nor does its folder"),
        ("shards-{000..002}.tar", "3 of the 3 shards of shards-{000..002}.tar do not exist"),
        ("shards-{2..0}.tar", "must count up"),
    ):
        assert words in refused("embed", "--model", tiny, "--data", data, "--out", tmp_path / "f.parquet")
    assert list(tmp_path.iterdir()) == []
