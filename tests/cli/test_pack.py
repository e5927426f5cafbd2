"""`derender pack`: fewer bytes, nearly the same model, what lies beside it; refusals."""

import json

import pytest
import torch
from tests.cli.conftest import face_files

from derender.cli import main
from derender.data.synthetic import faces
from derender.evaluation.scenes import copy_cost
from derender.model import load
from derender.storage.sharing import pack_model

FILES = ("model.safetensors", "whitening.safetensors", "fitting.safetensors")


@pytest.fixture(scope="module")
def unpacked(tmp_path_factory):
    """Weights and maps of no round numbers, saved in float32 as training does; features are not fitted."""
    model = load("rendered-faces-64")
    model = model.with_features(model.features.with_steps(0))
    generator = torch.Generator().manual_seed(0)
    for value in (*model.parameters(), *model.whitening.buffers(), *model.fitting.buffers()):
        if value.is_floating_point() and value.ndim > 1:
            value.mul_(1 + 1e-3 * torch.randn(value.shape, generator=generator))
    return model.save_pretrained(tmp_path_factory.mktemp("unpacked") / "model", data="faces", licence="MIT")


@pytest.fixture(scope="module")
def pictures():
    return faces.generate(12, image_size=64, seed=4).images


def bytes_of(folder):
    return sum((folder / name).stat().st_size for name in FILES)


def test_a_copy_takes_half_the_bytes_and_says_nearly_the_same(unpacked, pictures, tmp_path, capsys):
    folder = face_files(tmp_path / "pictures", 12, seed=4)
    code = main(["pack", "-m", str(unpacked), "-o", str(tmp_path / "p"), "-d", str(folder), "--json", "-"])
    assert code == 0
    printed = json.loads(capsys.readouterr().out)
    assert printed["bytes"] == {"before": bytes_of(unpacked), "after": bytes_of(tmp_path / "p")}
    assert printed["bytes"]["after"] < 0.52 * printed["bytes"]["before"]
    assert printed["pictures"] == 12
    assert all(0 < share < 0.05 for share in printed["cost"]["moved"].values())
    assert printed["cost"]["l1"] == pytest.approx(printed["cost"]["l1_before"], rel=0.01)


def test_its_cost_is_that_of_the_features_it_gives(unpacked, pictures, tmp_path):
    pack_model(unpacked, tmp_path / "p")
    one, two = load(unpacked), load(tmp_path / "p")
    with torch.no_grad():
        batch = torch.from_numpy(pictures).float() / 255
        features = [model.embed(batch)["camera"].double() for model in (one, two)]
    pairs = torch.cdist(features[0], features[0]).square().sum() / (12 * 11)
    moved = (features[0] - features[1]).norm(dim=1).mean() / pairs.sqrt()
    assert copy_cost(one, two, pictures)["moved"]["camera"] == pytest.approx(float(moved), rel=1e-3)
    told = []
    none = copy_cost(one, one, pictures, progress=lambda done, whole: told.append((done, whole)))
    assert set(none["moved"].values()) == {0.0} and none["l1"] == none["l1_before"]
    assert told == [(12, 24), (24, 24)]


def test_card_errors_and_split_go_along(tmp_path):
    pack_model("faces-64", packed := tmp_path / "p")
    own = load("faces-64").source
    assert own is not None
    for name in ("README.md", "held_out_errors.json", "split.json", "config.json"):
        assert (packed / name).read_bytes() == (own / name).read_bytes()


@pytest.mark.parametrize("value", [1e6, float("nan")])
def test_weights_beyond_half_precision_are_refused(tmp_path, value):
    model = load("rendered-faces-64")
    with torch.no_grad():
        next(model.nets["light"].parameters()).view(-1)[0] = value
    folder = model.save(tmp_path / "odd")
    with pytest.raises(ValueError, match="half precision"):
        pack_model(folder, tmp_path / "p")
    assert not (tmp_path / "p").exists()


def test_what_cannot_be_packed_is_refused(unpacked, tmp_path, refused):
    pack = ("pack", "-m", unpacked, "-o")
    assert "add --force" in refused(*pack, tmp_path)
    assert "choose bytes or float16" in refused(*pack, tmp_path / "p", "--maps", "int4")
    assert "give the images, too" in refused(*pack, tmp_path / "p", "--part", "test")
    assert not (tmp_path / "p").exists()
