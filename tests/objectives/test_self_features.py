"""The self-trained features: exact correspondences, exact folding, determinism, and that they learn."""

import pytest
import torch
from safetensors.torch import save_file
from torch import Generator, nn
from torch.nn import functional

from derender.objectives import self_features
from derender.objectives.self_features import SelfTraining, load_self_features, train_self_features

QUICK = SelfTraining(widths=(8, 8, 16), batch=8, places=8, crop=24, projection=16)


def blobs(n: int, generator: Generator, size: int = 32) -> torch.Tensor:
    """Images of smooth random colour with a few sharp discs: detail at several scales."""
    coarse = torch.rand(n, 3, 5, 5, generator=generator)
    smooth = functional.interpolate(coarse, size, mode="bicubic").clamp(0, 1)
    row = torch.arange(size).view(1, size, 1)
    column = torch.arange(size).view(1, 1, size)
    for _ in range(6):
        centre = torch.rand(n, 2, generator=generator) * size
        radius = 1.5 + 3 * torch.rand(n, 1, 1, generator=generator)
        inside = (row - centre[:, :1, None]) ** 2 + (column - centre[:, 1:, None]) ** 2 < radius**2
        smooth = torch.where(inside[:, None], torch.rand(n, 3, 1, 1, generator=generator), smooth)
    return smooth


def as_bytes(images: torch.Tensor) -> torch.Tensor:
    return (images * 255).round().byte()


@pytest.mark.parametrize(("height", "width"), [(32, 32), (64, 48), (20, 33)])
def test_places_of_two_views_show_the_same_point(monkeypatch, generator, height, width):
    monkeypatch.setattr(self_features, "photometric_augmentation", lambda images, generator: images)
    n, stride = 40, 4
    rows, columns = torch.meshgrid(torch.arange(float(height)), torch.arange(float(width)), indexing="ij")
    number = torch.arange(float(n)).view(n, 1, 1).expand(n, height, width)
    pictures = torch.stack([rows.expand(n, -1, -1), columns.expand(n, -1, -1), number], dim=1)
    pair = self_features.two_views(pictures, 40, stride, 12, generator)
    cells = pair.first.shape[-1] // stride
    first, second = (
        functional.avg_pool2d(view, stride).flatten(2).gather(2, places[:, None].expand(n, 3, 12))
        for view, places in ((pair.first, pair.first_places), (pair.second, pair.second_places))
    )
    torch.testing.assert_close(first, second, rtol=0, atol=1e-4)
    assert torch.equal(first[:, 2], number[:, 0, :1].expand(n, 12))
    assert pair.first_places.min() >= 0 and pair.first_places.max() < cells**2
    assert (pair.first_places != pair.second_places).any(), "some crops must differ"
    mirrored = pair.first[:, 1, 0, 0] > pair.first[:, 1, 0, -1]
    assert mirrored.any() and not mirrored.all()


def test_folding_the_normalisation_changes_nothing(generator):
    widths = (4, 6, 5)
    layers = self_features.trunk(widths, normalised=True).train()
    for module in layers:
        if isinstance(module, nn.BatchNorm2d):
            nn.init.normal_(module.weight, 1, 0.3, generator=generator)
            nn.init.normal_(module.bias, 0, 0.3, generator=generator)
    with torch.no_grad():
        for _ in range(3):
            layers(torch.rand(8, 3, 16, 12, generator=generator))
        layers.eval()
        images = torch.rand(2, 3, 16, 12, generator=generator)
        folded = self_features.without_normalisation(layers)
        torch.testing.assert_close(folded(images), layers(images), rtol=1e-4, atol=1e-5)
    assert not any(isinstance(module, nn.BatchNorm2d) for module in folded)


def test_the_same_seed_gives_the_same_weights_and_global_state_is_left_alone(generator):
    images = as_bytes(blobs(12, generator))
    torch.manual_seed(1)
    one = train_self_features(images, seed=3, steps=3, settings=QUICK)
    after = torch.rand(1)
    torch.manual_seed(1)
    assert torch.equal(torch.rand(1), after)
    torch.manual_seed(2)
    two = train_self_features(images, seed=3, steps=3, settings=QUICK)
    other = train_self_features(images, seed=4, steps=3, settings=QUICK)
    for name, value in one.state_dict().items():
        assert torch.equal(two.state_dict()[name], value), name
    assert not torch.equal(one.features[0].weight, other.features[0].weight)


def test_training_learns_to_recognise_places_and_to_order_distortions(generator):
    """After a hundred steps: places are recognised, detail and position count, brightness hardly does."""
    pictures, unseen = as_bytes(blobs(96, generator)), blobs(24, generator)
    losses: list[float] = []
    how = {"settings": QUICK, "progress": lambda step, steps, loss: losses.append(loss)}
    trained = train_self_features(pictures, seed=0, steps=100, **how)
    assert len(losses) == 100
    assert sum(losses[-10:]) / 10 < sum(losses[:10]) / 10 - 1.0
    still = SelfTraining(**{**vars(QUICK), "learning_rate": 1e-12})
    untrained = train_self_features(pictures, seed=0, steps=1, settings=still)

    def distances(net):
        target = net(unseen)

        def distance(images):
            return (net(images) - target).square().mean().item()

        shifts = {f"shift {pixels}": distance(unseen.roll(pixels, 3)) for pixels in (1, 2, 4)}
        result = {"darker": distance(unseen * 0.8), **shifts}
        return {name: value / distance(unseen.roll(1, 0)) for name, value in result.items()}

    after, before = distances(trained), distances(untrained)
    assert after["shift 1"] < after["shift 2"] < after["shift 4"] < 1.2
    assert after["darker"] < 0.5 * before["darker"]
    assert after["darker"] < after["shift 2"]


def test_save_and_load_give_the_same_features(tmp_path, generator):
    net = train_self_features(as_bytes(blobs(6, generator)), seed=0, steps=1, settings=QUICK)
    net.save(tmp_path / "features.safetensors")
    loaded = load_self_features(tmp_path / "features.safetensors")
    images = torch.rand(2, 3, 24, 16, generator=generator)
    assert torch.equal(loaded(images), net(images))
    assert loaded.widths == (8, 8, 16) and not loaded.training


def test_files_that_are_something_else_are_refused(tmp_path):
    (tmp_path / "damaged").write_bytes(b"no")
    save_file({"weight": torch.zeros(2)}, tmp_path / "other")
    save_file({"weight": torch.zeros(2)}, tmp_path / "cut", {"kind": "self", "widths": "[8, 8, 16]"})
    refused = {"absent": "cannot be read", "damaged": "cannot be read", "other": "something else wrote it"}
    for name, message in {**refused, "cut": "does not fit its own widths"}.items():
        with pytest.raises(ValueError, match=message):
            load_self_features(tmp_path / name)


def test_bad_input_is_named(generator):
    images = as_bytes(blobs(3, generator))
    with pytest.raises(ValueError, match="at least 2 images"):
        train_self_features(images[:1], seed=0, steps=1)
    with pytest.raises(ValueError, match="at least 1 step"):
        train_self_features(images, seed=0, steps=0)
    with pytest.raises(ValueError, match="8 x 32 are too small"):
        train_self_features(images[:, :, :8], seed=0, steps=1)
    with pytest.raises(ValueError, match="three positive widths"):
        self_features.SelfFeatures((8, 0, 8))
