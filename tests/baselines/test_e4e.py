"""The e4e encoder: which code sees what, its regularisers; and runs of a generator and of its inversion."""

import pytest
import torch
from tests.baselines.conftest import config

from derender.baselines import baseline_config, load_baseline, open_baseline, train_baseline
from derender.baselines.e4e import E4e, E4eConfig, E4eSettings, EncoderSettings
from derender.baselines.generator import GeneratorSettings
from derender.baselines.stylegan2 import Stylegan
from derender.training.run_folder import read_metrics

TINY = GeneratorSettings(image_size=32, style_size=6, mapping_layers=2, channel_base=64, channel_max=6)


@pytest.fixture
def model(seeded):
    return seeded(E4e, E4eSettings(image_size=32, width=4, units=(1, 1, 1, 1), generator=TINY)).eval()


@pytest.fixture
def images(generator):
    return torch.rand(2, 3, 32, 32, generator=generator)


def test_the_codes_are_the_first_and_what_is_added(model, images):
    """Codes that are not released are the first; then 3 coarse, 4 middle, the rest fine."""
    model.released.fill_(0)
    first = model.invert(images)
    assert torch.equal(first, first[:, :1].expand(-1, 8, -1))
    model.released.fill_(2)
    some = model.invert(images)
    assert torch.equal(some[:, [0, 3, 7]], first[:, [0, 3, 7]])
    assert not torch.equal(some[:, 1], first[:, 1]) and not torch.equal(some[:, 2], first[:, 2])
    model.released.fill_(7)
    whole = model.invert(images)
    for layer, changed in ((model.encoder.to_fine, [7]), (model.encoder.to_middle, [3, 4, 5, 6, 7])):
        with torch.no_grad():
            layer.bias.add_(1)
        result = model.invert(images)
        assert [code for code in range(8) if not torch.equal(result[:, code], whole[:, code])] == changed


def test_the_mean_code_is_added(model, images):
    before = model.embed(images)["w+"]
    model.centre.add_(2)
    torch.testing.assert_close(model.embed(images)["w+"], before + 2)
    assert before.shape == (2, 8 * 6)


def test_codes_are_released_one_by_one(model, images, losses):
    own = baseline_config("e4e", ["first_release=100", "release_every=10"])
    for seen, released in ((0, 0), (99, 0), (100, 1), (109, 1), (110, 2), (500, 41)):
        model.train().seen.fill_(seen)
        losses(model, images, own)
        assert model.released == released and model.seen == seen + 2


def test_losses_of_what_the_generator_made_from_its_mean_code(model, generator, losses):
    """With an encoder that says nothing the inversion is the mean code's image; then one head says 3, 4."""
    model.centre.copy_(torch.randn(6, generator=generator).expand(8, -1))
    for head in model.encoder.heads:
        head.linear.weight.data.zero_()
    images = model.rebuild(model.centre[None]).detach().expand(2, -1, -1, -1)
    terms = losses(model, images, E4eConfig())
    assert all(terms[name] < 1e-6 for name in ("reconstruction", "delta", "prior"))
    model.encoder.heads[1].linear.bias.data[:2] = torch.tensor([3.0, 4.0])
    terms = losses(model, images, E4eConfig())
    assert terms["delta"].item() == pytest.approx(5e-5 * 5, rel=1e-4) and terms["prior"] < 1e-6


def test_runs_leave_models_that_embed(runs, blobs):
    images = torch.from_numpy(blobs.images[:5]).float() / 255
    assert load_baseline(runs / "stylegan2").embed(images)["discriminator"].shape == (5, 6)
    model = load_baseline(runs / "e4e")
    assert isinstance(model, E4e) and model.embed(images)["w+"].shape == (5, 48)
    state = model.generator.state_dict()
    generator = Stylegan.open(runs / "stylegan2").generator
    assert all(torch.equal(value, state[key]) for key, value in generator.state_dict().items())
    assert model.seen == 48 and not torch.equal(model.centre, torch.zeros_like(model.centre))
    rows = read_metrics(runs / "e4e")
    assert {"reconstruction", "perceptual", "delta", "prior", "l1"} <= rows[0].keys()
    held_out = [row for row in rows if row["kind"] == "validation"][-1]
    assert held_out["loss"] == pytest.approx(held_out["reconstruction"] + held_out["perceptual"])
    judged = [row for row in read_metrics(runs / "stylegan2") if row["kind"] == "validation"][-1]
    assert judged["loss"] == judged["energy"]


def test_smaller_images_are_enlarged_to_the_encoder_when_they_are_requested(runs, blobs):
    model = open_baseline("e4e", str(runs / "e4e"), device="cpu", image_size=16)
    assert model.image_size == 16 and open_baseline("e4e", str(runs / "e4e"), device="cpu").image_size == 32
    small = torch.from_numpy(blobs.images[:2, :, ::2, ::2].copy()).float() / 255
    large = torch.nn.functional.interpolate(small, 32, mode="bilinear", align_corners=False)
    torch.testing.assert_close(model.embed(small)["w+"], model.invert(large).flatten(1))


def test_a_run_without_a_generator_is_refused_before_a_folder_is_made(runs, blobs, tmp_path):
    for more, told in (
        ([], "stylegan2 needs a model: a run of .* --model stylegan2, for e4e as --set generator=RUN"),
        ([f"generator={runs / 'e4e'}"], "holds the baseline 'e4e', asked for stylegan2"),
        ([f"generator={tmp_path / 'none'}"], "no baseline at"),
    ):
        with pytest.raises((ValueError, FileNotFoundError), match=told):
            train_baseline(config("e4e", 48, *more), blobs, tmp_path / "run")
        assert not (tmp_path / "run").exists()
    with pytest.raises(ValueError, match="8, 16, 32"):
        baseline_config("e4e", ["image_size=48"])
    with pytest.raises(ValueError, match="greater than 0"):
        EncoderSettings(units=(1, 0, 1, 1))
