"""Closed forms and laws of each renderer, its gradients, and training with it."""

import math

import numpy as np
import pytest
import torch
from tests.render.scenes import FOV_DEG, scene
from tests.tolerances import assert_agrees
from torch import Tensor

from derender.model import Derenderer
from derender.render import Rendering, available_backends, render_scene
from derender.renderers import RENDERERS, renderer_named
from derender.renderers.haze import through_haze, transmission
from derender.renderers.lambert_shadow import _lowest_step, clearance, visible
from derender.renderers.phong import highlight
from derender.scene import Scene, environment
from derender.scene.camera import focal_px
from derender.scene.light import lambert_shading, light_direction
from derender.scene.normals import normals_from_depth
from derender.scene.scene import seen_in_mirror
from derender.training.config import ObjectiveSettings
from derender.training.step import training_step

EXTRA = {"specular": [[0.3, 12.0]], "haze": [[1.5, 0.8]]}
ALL = (*RENDERERS, "sh(colour=true)", "phong(gamma=2.2)+lambert-shadow+haze", "sh+haze")


def scene_for(name: str, generator, count: int = 2, side: int = 16, dtype=torch.float64, light=None) -> Scene:
    """A random scene with all that the renderer needs; side light, so that there are shadows."""
    depth, albedo, own, camera = scene(count, side, side, generator, dtype)
    own[:, 2:] *= 2
    values = {"depth": depth, "albedo": albedo, "light": own if light is None else light, "camera": camera}
    for row in renderer_named(name).factors:
        if row.parameter == "environment":
            values["environment"] = environment.from_light(values["light"], 3 if "colour" in name else 1)
        else:
            values[row.parameter] = torch.tensor(EXTRA[row.parameter] * count, dtype=dtype)
    return Scene.from_parameters(values)


@pytest.mark.parametrize("name", ALL)
def test_gradients_of_every_parameter_are_those_of_finite_differences(name, generator):
    given, renderer = scene_for(name, generator, 1, 5), renderer_named(name)
    if "shadow" in name:  # of a ridge, with umbra and penumbra
        given.depth[:, :, 2] = 1 - torch.linspace(0.03, 0.04, 5)
        given.light[:, 2:] = torch.tensor([0.1, -1.05])
        share = visible(given.depth, given.light, FOV_DEG)
        assert ((share > 0.05) & (share < 0.95)).sum() > 1 and (share == 0).any()
    names, values = zip(*given.parameters.items(), strict=True)

    def image(*changed: Tensor) -> Tensor:
        result = Scene.from_parameters(dict(zip(names, changed, strict=True)))
        rendering = Rendering(renderer.shade(result, FOV_DEG), result.depth, torch.ones_like(result.depth))
        return (rendering if renderer.atmosphere is None else renderer.atmosphere(rendering, result)).image

    assert torch.autograd.gradcheck(image, [value.clone().requires_grad_() for value in values], atol=1e-4)


@pytest.mark.parametrize("name", ALL)
def test_a_training_step_teaches_every_network_of_a_renderer(name, generator):
    model = Derenderer.from_preset("small", seed=0, renderer=name, image_size=32, width=8, light_width=4)
    images = torch.rand(3, 3, 32, 32, generator=generator)
    objective = ObjectiveSettings(perceptual="none", loocc="all")
    training_step(model, images, objective, None, torch.Generator().manual_seed(0)).total.backward()
    for row in model.factors:
        gradients = [value.grad for value in model.nets[row.name].parameters()]
        assert all(gradient is not None and gradient.isfinite().all() for gradient in gradients), row.name
        assert sum(float(gradient.abs().sum()) for gradient in gradients) > 0, row.name
    scenes = model.decompose(images)
    for row in model.factors:
        if row.perturb is not None:
            args = (torch.Generator().manual_seed(1), objective.perturb, model.settings.ranges)
            changed = row.perturb(scenes.parameters[row.parameter], *args)
            model.renderer.check(scenes.with_parameters(**{row.parameter: changed}))


@pytest.mark.parametrize("name", ALL)
def test_a_scene_in_a_mirror_has_the_mirror_image(name, generator):
    given, renderer = scene_for(name, generator), renderer_named(name)
    twin = seen_in_mirror(given, ("specular", "haze"))
    image, mirrored = (renderer.shade(one, FOV_DEG) for one in (given, twin))
    apart = (mirrored.flip(-1) - image).abs().amax(dim=1)
    assert (apart < 1e-6).double().mean() > 0.95  # a ray's steps round to one side
    view, turned = (renderer(one, FOV_DEG) for one in (given, twin))
    assert (turned.image.flip(-1) - view.image).abs().mean() < 0.01


@pytest.mark.parametrize(("name", "off"), [("phong", [[0.0, 9.0]]), ("haze", None)])
def test_without_its_effect_a_renderer_is_lambert(name, off, generator):
    given = scene_for(name, generator)
    expected = render_scene(given, FOV_DEG)
    if name == "haze":
        clear = through_haze(expected, given.with_parameters(haze=torch.tensor([[0.0, 0.5]] * 2).double()))
        assert_agrees(clear.image, expected.image)
        return
    given = given.with_parameters(specular=torch.tensor(off * 2).double())
    assert_agrees(renderer_named(name)(given, FOV_DEG).image, expected.image, "image")
    bright = renderer_named("phong(gamma=2.2)").shade(given, FOV_DEG)
    shading = lambert_shading(normals_from_depth(given.depth, FOV_DEG), given.light)
    expected = given.albedo * shading ** (1 / 2.2)
    assert_agrees(bright, expected.clamp(min=1e-6 ** (1 / 2.2)), "image in linear light")


def flat(light: list[float], yaw: float = 0.0, side: int = 9, **extra: Tensor) -> Scene:
    """A white plane that faces the canonical camera."""
    plane, camera = torch.ones(1, side, side).double(), torch.zeros(1, 6).double()
    camera[0, 1] = yaw
    lit = torch.tensor([light], dtype=torch.float64)
    return Scene(plane, plane[:, None].expand(1, 3, -1, -1), lit, camera, extra)


@pytest.mark.parametrize(("light_yaw", "camera_yaw"), [(0.0, 0.0), (0.7, 0.0), (0.7, 0.5), (0.4, -0.6)])
def test_a_highlight_has_blinns_closed_form_and_moves_with_the_view(light_yaw, camera_yaw):
    gloss = torch.tensor([[0.4, 20.0]], dtype=torch.float64)
    given = flat([0.2, 0.7, 0.0, light_yaw], camera_yaw, specular=gloss)
    result = highlight(given, normals_from_depth(given.depth, FOV_DEG), FOV_DEG)[0, 0, 4, 4]
    half = (light_yaw - camera_yaw) / 2  # the object turns: its own frame sees the camera turn the other way
    assert float(result) == pytest.approx(0.4 * 0.7 * math.cos(half) ** 20, rel=1e-9)


def test_a_highlight_is_only_where_light_falls(generator):
    light = torch.tensor([[0.3, 0.9, 0.3, 1.4]] * 2).double()
    given = scene_for("phong", generator, light=light)
    normal = normals_from_depth(given.depth, FOV_DEG)
    lit = (normal * light_direction(light)[:, None, None]).sum(dim=-1) > 0
    shine = highlight(given, normal, FOV_DEG)[:, 0]
    assert 0 < lit.float().mean() < 1
    assert (shine[~lit] == 0).all() and (shine[lit] > 0).any() and (shine >= 0).all()


def test_haze_is_koschmieders_law_over_the_depths_that_are_seen():
    depth = torch.linspace(0.95, 1.05, 5).double().view(1, 1, 5).repeat(1, 2, 1)
    mask = torch.ones_like(depth)
    mask[..., -1] = 0  # so that 1.025 is the farthest
    given = flat([1.0, 0.0, 0.0, 0.0], haze=torch.tensor([[2.0, 0.6]]).double())
    clear = Rendering(0.3 * mask[:, None].repeat(1, 3, 1, 1), depth * mask, mask)
    image = through_haze(clear, given).image[0, 0, 0]
    share = np.exp(-2 * np.array([0, 1 / 3, 2 / 3, 1]))
    np.testing.assert_allclose(image[:4], 0.3 * share + 0.6 * (1 - share), rtol=1e-6)
    assert image[4] == 0
    even = transmission(torch.ones(1, 3, 3), torch.ones(1, 3, 3), torch.tensor([4.0]))
    assert (even == 1).all()  # of a depth map without relief nothing is farther


def test_renderers_combine_in_the_order_of_light(generator):
    given = scene_for("phong+lambert-shadow+haze", generator)
    phong, shadow = renderer_named("phong"), renderer_named("lambert-shadow")
    both = renderer_named("phong+lambert-shadow")
    bare = given.with_parameters(specular=torch.tensor([[0.0, 9.0]] * 2).double())
    assert_agrees(both.shade(bare, FOV_DEG), shadow.shade(given, FOV_DEG), "without gloss")
    share = shadow.visibility(given, FOV_DEG)[:, None]
    gloss = phong.shade(given, FOV_DEG) - phong.shade(bare, FOV_DEG)
    expected = shadow.shade(given, FOV_DEG) + share * gloss
    assert_agrees(both.shade(given, FOV_DEG), expected, "gloss in shadow")
    hazy = renderer_named("phong+lambert-shadow+haze")(given, FOV_DEG)
    assert_agrees(hazy.image, through_haze(both(given, FOV_DEG), given).image, "behind haze")


def bumps(generator, side: int = 40) -> Tensor:
    noise = torch.randn(4, 1, 6, 6, generator=generator).double()
    return 1 + 0.03 * torch.nn.functional.interpolate(noise, size=(side, side), mode="bicubic")[:, 0]


def test_shadows_are_those_of_a_ray_cast_outside_the_soft_edge(generator):
    depth = bumps(generator)
    light = torch.tensor([[0.3, 0.7, 0, 1.1], [0.3, 0.7, 0.9, 0], [0.3, 0.7, -0.6, -0.9], [0.3, 0.7, 0, 0]])
    towards, result = -light_direction(light.double()), visible(depth, light.double(), FOV_DEG, 5.0)
    places = torch.ones_like(depth).nonzero(as_tuple=True)
    lowest = torch.ones(depth.numel()).double()
    for pixels in np.arange(0.1, 60, 0.1):  # fractions of the march's steps: k + k^2 / 12 = pixels
        step = torch.full_like(lowest, (math.sqrt(1 + pixels / 3) - 1) * 6)
        lowest = torch.minimum(lowest, clearance(depth, towards, places, step, focal_px(40, FOV_DEG)))
    lowest = lowest.view_as(depth)
    dark, lit = lowest < -math.tan(math.radians(7)), lowest > 0
    assert 0.02 < dark.double().mean() < 0.6 and (result[3] == 1).all()  # a frontal light casts none
    assert (result[lit] == 1).all()
    assert (result[dark] < 0.02).double().mean() > 0.99
    assert ((result > 0) & (result < 1)).any()


def test_a_surface_that_bulges_shades_itself_nowhere():
    v, u = torch.meshgrid(*[torch.linspace(-1, 1, 33).double()] * 2, indexing="ij")
    depth = (1 + 0.05 * (u * u + v * v))[None]
    light = torch.tensor([[0.3, 0.7, 0.5, 1.2]]).double()
    lit = (normals_from_depth(depth, FOV_DEG) * light_direction(light)[:, None, None]).sum(dim=-1) > 0
    assert (visible(depth, light, FOV_DEG)[lit] == 1).all()


@pytest.mark.skipif("numba" not in available_backends(), reason="numba is not installed")
def test_the_fast_search_of_shadows_finds_the_same_steps(generator):
    from derender.renderers.shadow_numba import lowest_step

    light = 2 * torch.rand(4, 4, generator=generator).double() - 1
    light[0, 2:], depth = 0.02, bumps(generator)[:, :27].contiguous()
    towards, focal = -light_direction(light), focal_px(40, FOV_DEG)
    expected = _lowest_step(depth, towards, focal)
    assert (expected > 0).float().mean() > 0.05
    assert torch.equal(lowest_step(depth, towards, focal), expected)


def sphere() -> tuple[Tensor, Tensor]:
    """Directions all over the sphere, and weights with which polynomials are integrated exactly."""
    z, weight = np.polynomial.legendre.leggauss(8)
    angle = np.arange(16) * np.pi / 8
    flat_z, flat_angle = np.repeat(z, 16), np.tile(angle, 8)
    radius = np.sqrt(1 - flat_z**2)
    directions = np.stack([radius * np.cos(flat_angle), radius * np.sin(flat_angle), flat_z], axis=1)
    return torch.from_numpy(directions), torch.from_numpy(np.repeat(weight, 16) * np.pi / 8)


def test_harmonics_are_orthonormal_and_meet_a_lamp(generator):
    directions, weight = sphere()
    basis = environment.harmonics(directions)
    assert_agrees(basis.T @ (basis * weight[:, None]), torch.eye(9).double(), "products")
    light = torch.rand(6, 4, generator=generator).double()
    assert_agrees(environment.main_light(environment.from_light(light, 3)), light, "there and back")
    normal = directions.expand(6, 1, -1, 3)
    shading = lambert_shading(normal, light)
    off = environment.irradiance(environment.from_light(light), normal) - shading
    assert float((off.abs() / light[:, 1, None, None, None]).max()) < 0.1  # of the cosine lobe, known: 3/32
    dark = environment.from_light(light * torch.tensor([0, 1, 1, 1]))
    for orders, limit in zip((slice(1, 4), slice(4, 9)), environment.LIMITS, strict=True):
        expected = torch.full((6,), limit, dtype=torch.float64)
        assert_agrees(dark[:, orders].norm(dim=1) / dark[:, 0], expected, "limit")


def test_environments_are_bounded_and_give_way_to_a_lamp(generator):
    raw = 2 * torch.rand(50, 27, generator=generator) - 1
    result = environment.bounded(raw, (0.1, 1.25)).view(50, 3, 9)
    mean = result[..., 0] * environment.MEAN
    assert mean.min() >= 0.1 and mean.max() <= 1.25
    for orders, limit in zip((slice(1, 4), slice(4, 9)), environment.LIMITS, strict=True):
        assert (result[..., orders].norm(dim=-1) <= limit * result[..., 0] * (1 + 1e-5)).all()
    given = scene_for("sh", generator)
    other = given.with_parameters(environment=given.extra["environment"].flip(0))
    assert_agrees(other.light, given.light.flip(0), "its main light")
    relit = given.with_parameters(light=given.light.flip(0))
    assert "environment" not in relit.extra
    sh = renderer_named("sh")
    assert_agrees(sh(relit, FOV_DEG).image, sh(other, FOV_DEG).image, "under the other's light")
