"""The framing network: learned from random crops without labels, it undoes an image's crop in any light."""

import pytest
import torch
from torch.nn.functional import interpolate

import derender
from derender.data.synthetic import faces
from derender.objectives.reconstruction import masked_l1
from derender.postprocess import Features
from derender.postprocess.fitting import coordinates_of
from derender.postprocess.framing import Framing
from derender.postprocess.whitening import Whitening
from derender.scene.crop import back, crop_images, crop_scene, parameters_of, similarities, within
from derender.storage.tensors import write_tensors
from derender.training import framing as training
from derender.training.framing import drawn_crops, fit_framing

MOVES = torch.tensor([[-0.25, 0.0, 0.1, 0.1], [0.2, 0.15, 0.0, -0.1], [-0.2, -0.15, -0.1, 0.0]])


@pytest.fixture(scope="module")
def model() -> derender.Derenderer:
    return derender.load("faces-64")


@pytest.fixture(scope="module")
def heads() -> torch.Tensor:
    return torch.from_numpy(faces.generate(24, 96, seed=31).images).float() / 255


def moved(images: torch.Tensor, move: torch.Tensor) -> torch.Tensor:
    return crop_images(images, similarities(move.expand(len(images), 4)))


def test_crops_of_crops_and_the_way_back():
    one, other = similarities(MOVES), similarities(MOVES.flip(0))
    torch.testing.assert_close(parameters_of(one), MOVES)
    unmoved = similarities(torch.zeros(3, 4))
    torch.testing.assert_close(within(back(one), one), unmoved, atol=1e-6, rtol=0)
    torch.testing.assert_close(within(one, back(one)), unmoved, atol=1e-6, rtol=0)
    points = torch.randn(3, 2, 1)
    inner = other[:, :, :2] @ points + other[:, :, 2:]
    expected = one[:, :, :2] @ inner + one[:, :, 2:]
    both = within(other, one)
    torch.testing.assert_close(both[:, :, :2] @ points + both[:, :, 2:], expected)


def test_a_network_learns_from_crops_alone(monkeypatch):
    monkeypatch.setattr(training, "BATCH", 16)
    monkeypatch.setattr(training, "WARMUP", 20)
    plain = derender.load("rendered-faces-64").without_features()
    images = torch.from_numpy(faces.generate(80, 64, seed=7).images)
    framing = fit_framing(plain, images[:64], 16 * 140, seed=1)
    examples = training._examples(plain, images[64:], torch.arange(16), torch.Generator().manual_seed(1))
    shown, wanted = drawn_crops(*examples, torch.Generator().manual_seed(2))
    answers, errors = framing.answers(shown)
    assert (answers - wanted).square().mean() < 0.9 * wanted.square().mean()
    assert 0.3 < float(((answers - wanted) / errors).square().mean()) < 6
    assert framing.crops(images[:2].float() / 255).requires_grad is False


def test_the_bundled_network_brings_crops_of_a_head_together(model, heads):
    framing, middle = model.whitening.framing, heads[..., 12:-12, 12:-12]
    reference = framing.crops(middle)
    for move in MOVES:
        back_again = within(framing.crops(moved(middle, move)), similarities(move.expand(len(heads), 4)))
        apart = (parameters_of(back_again) - parameters_of(reference)).abs().median(dim=0).values
        assert (apart < torch.tensor([0.06, 0.05, 0.05, 0.05])).all()


def test_where_nothing_is_known_an_image_stays_bit_for_bit(model):
    blank = torch.rand(3, 1, 1, 1).expand(3, 3, 64, 64)
    noise = torch.rand(3, 3, 64, 64, generator=torch.Generator().manual_seed(0))
    for images in (blank, noise):
        assert torch.equal(model.whitening.framing(images), images)


def test_features_follow_the_crop_less_than_without(model, heads):
    unframed = derender.load("faces-64")
    unframed.whitening.framing = None
    whole = interpolate(heads, (64, 64), mode="bilinear", antialias=True)
    for name in ("geometry", "albedo"):
        likeness = []
        for one in (model, unframed):
            with torch.no_grad():
                pair = [one.embed(images)[name] for images in (whole, moved(whole, MOVES[1]))]
            likeness.append(float(torch.cosine_similarity(*pair).mean()))
        assert likeness[0] > max(0.85, likeness[1] + 0.1)


def test_scenes_are_found_in_the_crop_and_their_cameras_move_back(model, heads):
    images = interpolate(moved(heads[:8], MOVES[1]), (64, 64), mode="bilinear", antialias=True)
    unframed = model.with_features(Features(fitting=model.fitting))
    with torch.no_grad():
        framed, crops = model.framed(images)
        scenes = model.decompose(images), model.fit_scenes(images, 2).scene
        inside = unframed.decompose(framed), unframed.fit_scenes(framed, 2).scene
        shown = [model.render(one) for one in (scenes[0], unframed.decompose(images))]
        error, before = (float(masked_l1(one.image, images, one.mask)) for one in shown)
        coordinates = model.with_features(model.features.with_steps(2)).activations(images)
        start, two = unframed.decode(unframed.encode(framed)), unframed.features.with_steps(2)
    assert not torch.equal(framed, images) and torch.equal(framed, model.whitening.framing(images))
    for scene, found in zip(scenes, inside, strict=True):
        assert torch.equal(scene.depth, found.depth) and torch.equal(scene.light, found.light)
        torch.testing.assert_close(crop_scene(scene, crops, model.fov_deg).camera, found.camera)
    fitted = unframed.fit_scenes(framed, 2).coordinates["geometry"]
    assert error < 0.95 * before and torch.equal(coordinates[coordinates_of("geometry")], fitted)
    begun = unframed.with_features(two).activations(framed, scenes=start)[coordinates_of("geometry")]
    torch.testing.assert_close(begun, fitted, rtol=1e-3, atol=1e-3)
    assert torch.equal(model.canonical_view(images), model.frontal(framed))


def test_a_network_is_kept_in_the_file_of_whitening(model, tmp_path):
    model.whitening.save(tmp_path / "whitening.safetensors")
    again = Whitening.load(tmp_path / "whitening.safetensors").framing
    for name, value in model.whitening.framing.named_buffers():
        assert torch.equal(again.get_buffer(name), value)
    tensors = dict(model.whitening.named_buffers())
    tensors["framing.weight1"] = tensors["framing.weight1"][:, :5].contiguous()
    write_tensors(tensors, tmp_path / "broken.safetensors")
    with pytest.raises(ValueError, match="a framing network has a 'weight1' of"):
        Whitening.load(tmp_path / "broken.safetensors")
    with pytest.raises(ValueError, match="'bias0'"):
        Framing({"weight0": torch.zeros(24, 3, 3, 3)})
    assert Features(model.whitening).framing("light") is None
