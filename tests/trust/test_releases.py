"""What earlier releases saved is read as it was meant; what later ones save is refused in one clear line."""

import json
import shutil
from functools import partial
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
import torch
from PIL import Image
from tests.trust.releases import make

import derender
from derender.baselines import load_baseline
from derender.data import read_images
from derender.data.cache import _MARK, read_cache
from derender.features import FeatureTable, missing
from derender.interpretation.probe import Probe, load_probe
from derender.overrides import checked
from derender.storage.places import CONFIG_FILE
from derender.training.checkpoint import TrainState, load_checkpoint
from derender.training.config import TrainConfig
from derender.training.run_folder import read_config, read_config_tree, read_metrics

RELEASES = Path(__file__).with_name("releases")
VERSIONS = sorted(folder.name for folder in RELEASES.iterdir() if (folder / "expected.json").is_file())
LARGEST_BYTES = 250_000
NEWER = r"format 2.*(reads up to 1: update|newer than this version of) derender"


@pytest.fixture(params=VERSIONS)
def release(request) -> Path:
    return RELEASES / request.param


@pytest.fixture
def copy(tmp_path) -> Path:
    """The newest release's files, to be changed."""
    return Path(shutil.copytree(RELEASES / VERSIONS[-1], tmp_path / "release"))


def expected(release: Path, what: str):
    return json.loads((release / "expected.json").read_text())[what]


def test_a_release_is_small(release):
    assert sum(file.stat().st_size for file in release.rglob("*") if file.is_file()) < LARGEST_BYTES


def test_its_model_gives_the_numbers_it_gave(release):
    """To 1e-3 of the largest: sums in another order change less, another definition changes far more."""
    result = make.numbers_of(derender.load(release / "model"))
    wanted = expected(release, "model")
    assert result.keys() == wanted.keys()
    for name, values in wanted.items():
        actual, values = np.array(result[name]), np.array(values)
        assert actual.shape == values.shape and np.abs(values).max() > 0, name
        assert np.abs(actual - values).max() <= 1e-3 * np.abs(values).max(), name


def test_its_model_has_whitening(release):
    model = derender.load(release / "model")
    codes, features = model.encode(make.pictures()), model.embed(make.pictures())
    assert model.whitening is not None
    assert not torch.allclose(codes["geometry"], features["geometry"])
    assert torch.equal(codes["light"], features["light"])


def test_its_feature_table_holds_what_was_written(release):
    result, wanted = FeatureTable.read(release / "table.parquet"), make.table()
    assert result.files == wanted.files and dict(result.origin) == dict(wanted.origin)
    assert list(result.factors) == list(wanted.factors) and list(result.labels) == list(wanted.labels)
    for name, values in wanted.factors.items():
        np.testing.assert_array_equal(result.factors[name], values)
    for name, values in wanted.labels.items():
        there = ~missing(values)
        np.testing.assert_array_equal(~missing(result.labels[name]), there)
        assert result.labels[name][there].tolist() == values[there].tolist()


def test_its_checkpoint_goes_on(release):
    net, optimiser = make.learner()
    state = load_checkpoint(release / "checkpoint", net, optimiser)
    assert state == TrainState(640, 1.5, 0.25, 2, {"a": {"b": 1}})
    for name, value in net.state_dict().items():
        assert value.tolist() == expected(release, "weights")[name]
    assert [float(entry["step"]) for entry in optimiser.state.values()] == [1.0] * 4
    assert tuple(optimiser.param_groups[0]["betas"]) == (0.8, 0.9)
    before = net.state_dict()["0.weight"].clone()
    net(torch.ones(1, 3)).sum().backward()
    optimiser.step()
    assert not torch.equal(net.state_dict()["0.weight"], before)


def test_the_configuration_and_metrics_of_its_run_are_read(release):
    assert read_config(release / "run") == checked(expected(release, "config"), TrainConfig)
    assert read_metrics(release / "run") == [{"kind": "train", "images": 640, "l1": 0.125}]


def later(file: Path, **change) -> None:
    """A JSON file of the next format."""
    content = json.loads(file.read_text())
    file.write_text(json.dumps({**content, "format": content["format"] + 1, **change}))


def later_table(file: Path) -> None:
    table = pq.read_table(file)
    described = json.loads(table.schema.metadata[b"derender"])
    told = json.dumps({**described, "format": described["format"] + 1}).encode()
    pq.write_table(table.replace_schema_metadata({b"derender": told}), file)


@pytest.mark.parametrize(
    ("read", "place", "change"),
    [
        (derender.load, "model", lambda folder: later(folder / CONFIG_FILE)),
        (load_baseline, "model", lambda folder: later(folder / CONFIG_FILE, baseline="ae")),
        (FeatureTable.read, "table.parquet", later_table),
        (load_probe, "probe", lambda folder: later(folder / "probe.json")),
    ],
    ids=["model", "baseline", "table", "probe"],
)
def test_what_comes_from_the_future_is_refused(copy, read, place, change):
    probe = Probe("classes", ("a", "b"), {"f": 3}, np.zeros((2, 3), np.float32), np.zeros(2, np.float32))
    assert load_probe(probe.save(copy / "probe")).names == ("a", "b")
    change(copy / place)
    with pytest.raises(ValueError, match=NEWER):
        read(copy / place)


def test_a_run_from_the_future_and_one_from_before_formats_were_counted(copy):
    """The format speaks before a setting that is not known yet does."""
    file = copy / "run" / "config.yaml"
    text = file.read_text()
    assert text.startswith("format: 1\n")
    file.write_text(text.replace("format: 1", "format: 2") + "invented_later: 3\n")
    with pytest.raises(ValueError, match="written in format 2, this version reads up to 1: update derender"):
        read_config(copy / "run")
    for odd in ("[1]", "'1'", "null", "1.5", "{}"):
        file.write_text(text.replace("format: 1", f"format: {odd}"))
        with pytest.raises(ValueError, match="was written in format"):
            read_config_tree(copy / "run")
    file.write_text(text.removeprefix("format: 1\n"))
    assert read_config(copy / "run").optimiser.learning_rate == 2e-4


def test_a_cache_from_the_future_is_made_again(tmp_path):
    (tmp_path / "images").mkdir()
    for number in range(2):
        Image.new("RGB", (8, 8), (40 * number, 9, 9)).save(tmp_path / "images" / f"{number}.png")
    read = partial(read_images, tmp_path / "images", 8, cache=tmp_path / "kept", workers=1)
    rows = read().images
    (file,) = (tmp_path / "kept").iterdir()
    whole = file.read_bytes()
    assert whole.endswith(_MARK) and _MARK.endswith(b"2\n")
    file.write_bytes(whole[: -len(_MARK)] + _MARK.replace(b"2\n", b"3\n"))
    assert read_cache(file, "any", 8) is None
    assert (read().images == rows).all() and file.read_bytes().endswith(_MARK)
