"""SimCLR: its loss against another implementation, its views, and what it needs for physical ones."""

from contextlib import nullcontext

import pytest
import torch
from pytorch_metric_learning.losses import NTXentLoss

from derender.baselines.augment import AugmentSettings
from derender.baselines.model import LossInputs
from derender.baselines.simclr import (
    Simclr,
    SimclrConfig,
    SimclrObjective,
    SimclrSettings,
    physical_view,
    twin_found,
    views_of,
)
from derender.model import Derenderer
from derender.scene.perturb import PerturbSettings

TINY = SimclrSettings(image_size=32, width=8, code_size=16, projection=6)


def config(objective: SimclrObjective) -> SimclrConfig:
    return SimclrConfig(model=TINY, objective=objective)


def model() -> Simclr:
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        return Simclr(TINY)


@pytest.fixture(scope="module")
def physics() -> Derenderer:
    return Derenderer.from_preset("small", seed=0, image_size=32, width=8, light_width=4).eval()


def test_the_loss_is_nt_xent_of_the_projections():
    net, images = model(), torch.rand(5, 3, 32, 32)
    objective = SimclrObjective(temperature=0.2)
    noisy = lambda images, generator: images + torch.rand(images.shape, generator=generator) / 4  # noqa: E731
    terms = net.losses(
        images, LossInputs(config(objective), torch.Generator().manual_seed(3), nullcontext, noisy)
    )
    generator = torch.Generator().manual_seed(3)
    views = [noisy(images, generator), noisy(images, generator)]
    codes = torch.cat([net.head(net.encoder(view)) for view in views])
    oracle = NTXentLoss(temperature=0.2)(codes, torch.arange(5).repeat(2))
    torch.testing.assert_close(terms["nt_xent"], oracle)
    torch.testing.assert_close(terms["found"], twin_found(codes[:5], codes[5:]))


def test_twin_found_is_one_for_twins_and_low_for_strangers():
    codes = torch.randn(40, 8, generator=torch.Generator().manual_seed(0))
    assert twin_found(codes, 3 * codes) == 1
    assert twin_found(codes, codes.roll(1, dims=0)) == 0
    assert twin_found(codes, torch.randn(40, 8, generator=torch.Generator().manual_seed(1))) < 0.2


def test_learning_tells_pictures_apart(blobs):
    images = torch.from_numpy(blobs.images[:12]).float() / 255
    objective, net = SimclrObjective(augment=AugmentSettings(crop_from=0.8, blur=0, grey=0)), model().train()
    views = views_of(config(objective), torch.device("cpu"))
    optimiser, generator = torch.optim.Adam(net.parameters(), 3e-3), torch.Generator().manual_seed(0)
    losses = []
    for _ in range(40):
        loss = net.losses(images, LossInputs(config(objective), generator, nullcontext, views))["nt_xent"]
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        losses.append(loss.item())
    assert sum(losses[-5:]) < 0.8 * sum(losses[:5])


def test_features_come_before_the_head():
    net, images = model().eval(), torch.rand(3, 3, 32, 32)
    assert list(net.embed(images)) == ["features"]
    net.choose(("projection", "features"))
    made = net.embed(images)
    torch.testing.assert_close(made["projection"], net.head(made["features"]))
    assert made["features"].shape == (3, 16) and made["projection"].shape == (3, 6)


def test_physical_views_without_any_change_are_the_reconstruction(physics):
    images = torch.rand(3, 3, 32, 32, generator=torch.Generator().manual_seed(0))
    still = PerturbSettings(ambient=0, diffuse=0, light_deg=0, camera_pitch_deg=0, camera_yaw_deg=0)
    rendering = physics.reconstruct(images)
    view = physical_view(physics, images, still, torch.Generator())
    seen = rendering.mask[:, None].expand_as(view) > 0
    torch.testing.assert_close(view[seen], rendering.image.clamp(0, 1)[seen], atol=1e-5, rtol=1e-4)


def test_physical_views_change_light_and_camera_and_nothing_else(physics, monkeypatch):
    images = torch.rand(4, 3, 32, 32, generator=torch.Generator().manual_seed(0))
    asked, render = [], physics.render

    def watched(scene):
        asked.append(scene)
        return render(scene)

    monkeypatch.setattr(physics, "render", watched)
    first, second = (
        physical_view(physics, images, PerturbSettings(), torch.Generator().manual_seed(seed))
        for seed in (0, 1)
    )
    scene = physics.decompose(images)
    assert len(asked) == 2
    for drawn in asked:
        torch.testing.assert_close(drawn.depth, scene.depth)
        torch.testing.assert_close(drawn.albedo, scene.albedo)
        assert not torch.isclose(drawn.light, scene.light).any()
        assert not torch.isclose(drawn.camera[:, :2], scene.camera[:, :2]).any()
        torch.testing.assert_close(drawn.camera[:, 2:], scene.camera[:, 2:])
    assert not torch.equal(first, second) and first.min() >= 0 and first.max() <= 1


def test_physical_views_need_a_model_of_that_size(physics, tmp_path):
    with pytest.raises(ValueError, match="views=physical and physics=RUN"):
        SimclrObjective(views="physical")
    with pytest.raises(ValueError, match="views=physical and physics=RUN"):
        SimclrObjective(physics="runs/x")
    missing = SimclrObjective(views="physical", physics=str(tmp_path / "none"))
    with pytest.raises(FileNotFoundError, match="no model at"):
        views_of(config(missing), torch.device("cpu"))
    saved = SimclrObjective(views="physical", physics=str(physics.save(tmp_path / "physics")))
    with pytest.raises(ValueError, match="takes images of 32 pixels, this run of 64: set image_size=32"):
        views_of(SimclrConfig(objective=saved), torch.device("cpu"))
    views = views_of(config(saved), torch.device("cpu"))
    images = torch.rand(2, 3, 32, 32)
    expected = physical_view(physics, images, saved.perturb, torch.Generator().manual_seed(5))
    torch.testing.assert_close(views(images, torch.Generator().manual_seed(5)), expected)
