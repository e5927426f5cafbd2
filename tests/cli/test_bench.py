"""`derender bench`: ratios of things that were shown to compute the same."""

import json
import time

import pytest
import torch

from derender.cli import main
from derender.speed import SpeedPair, measured, require_agreement


def test_the_quick_bench_reports_every_pair_with_the_machine(tmp_path, capsys):
    assert main(["bench", "--quick", "--json", str(tmp_path / "speed.json")]) == 0
    result = json.loads((tmp_path / "speed.json").read_text())
    assert [row["what"].split()[0] for row in result["rows"]] == ["rendering", "embedding", "Ward"]
    for row in result["rows"]:
        assert row["least"] <= row["ratio"] <= row["most"]
        assert row["ours_per_second"] > 0
    version, _, build = result["machine"]["packages"]["torch"].partition("+")
    assert version == torch.__version__.partition("+")[0] and build in torch.__version__
    waiting = result["waiting"]
    assert 0 < waiting["share"] < 1 and 0 < waiting["share_unaided"] < 1 and waiting["seconds"] > 0
    printed = capsys.readouterr().out
    assert "Ward clustering" in printed and "spent waiting for data" in printed


def test_the_same_work_in_half_the_time_is_a_ratio_of_two():
    pair = SpeedPair("a / b", "things", 20, lambda: time.sleep(0.01), lambda: time.sleep(0.02))
    row = measured(pair, rounds=3)
    assert row["least"] <= row["ratio"] <= row["most"]
    assert row["ratio"] == pytest.approx(2, rel=0.5)


def test_what_differs_is_not_measured():
    with pytest.raises(ValueError, match="the two sums differ by"):
        require_agreement("sums", [(torch.ones(2), torch.tensor([1.0, 1.1]))])
