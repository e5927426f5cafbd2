"""Laws of a photograph in its own detail: its own light and view return it, a mirror changes nothing else."""

import math

import pytest
import torch
from torch.nn.functional import avg_pool2d

from derender import load
from derender.data.synthetic import faces
from derender.data.synthetic.settings import LIGHTS, VIEWS, FaceSettings
from derender.photo import PhotoDetail
from derender.photo.detail import _over_exposed
from derender.render import render_scene
from derender.renderers import renderer_named
from derender.scene import Scene
from derender.scene.enlarge import at_size
from derender.scene.environment import from_light
from derender.scene.scene import seen_in_mirror

FOV = 10.0
SMALL, LARGE = 32, 96


def bump(light=(0.4, 0.5, 0.2, 0.3), camera=(0.05, 0.15, 0.02, 0.01, -0.01, 0.0)) -> Scene:
    """A smooth bump, symmetric, with a pattern of its own."""
    along = torch.linspace(-1, 1, SMALL)
    radius = along**2 + along[:, None] ** 2
    depth = 1.03 - 0.06 * (-2.5 * radius).exp()
    red = 0.5 + 0.2 * torch.sin(5 * along).expand(SMALL, -1)
    albedo = torch.stack((red, 0.6 + 0 * radius, 0.4 + 0.1 * radius / 2))
    return Scene(depth[None], albedo[None], torch.tensor([light]), torch.tensor([camera]))


def textured(scene: Scene, size: int = LARGE) -> torch.Tensor:
    """A photograph of the scene with detail that the scene's albedo does not have."""
    fine = at_size(scene, size)
    generator = torch.Generator().manual_seed(1)
    grain = 0.1 * torch.rand(1, 3, size, size, generator=generator)
    return render_scene(fine.with_parameters(albedo=(fine.albedo + grain).clamp(0, 1)), FOV).image[0]


@pytest.mark.parametrize(("size", "margin"), [(SMALL, 0.0), (LARGE, 0.0), (257, 0.0), (LARGE, 0.3)])
def test_own_light_and_view_return_the_photograph(size, margin):
    photo = torch.rand(3, size, size, generator=torch.Generator().manual_seed(0))
    scene = bump()
    seen = PhotoDetail(photo, scene, FOV, margin=margin)(scene)
    assert seen.image.shape == (1, 3, size, size)
    assert (seen.image[0] - photo).abs().max() <= 1 / 255


def test_a_visible_part_is_drawn_as_in_the_whole():
    scene = bump()
    photo, other = textured(scene), bump(light=(0.3, 0.8, 0.0, 0.6), camera=(0, 0.3, 0, 0, 0, 0))
    visible = slice(20, 70), slice(30, 96)
    part = PhotoDetail(photo, scene, FOV, visible=visible)(other)
    whole = PhotoDetail(photo, scene, FOV)(other)
    inner = (..., slice(32, 58), slice(42, 84))  # what is around it smooths the change of light at its border
    assert (part.image[inner] - whole.image[inner]).abs().max() < 0.01
    torch.testing.assert_close(part.depth[:, *visible], whole.depth[:, *visible])
    outside = torch.ones(LARGE, LARGE, dtype=torch.bool)
    outside[visible] = False
    assert (part.image[0, :, outside] == photo[:, outside]).all()


def over_exposed_skin() -> torch.Tensor:
    """(3, 1, 96, 96) skin, brighter to the right, past what can be shown; an eye's white on the left."""
    skin = torch.tensor([1.0, 0.8, 0.65])[:, None, None] * torch.linspace(0.4, 1.5, LARGE)
    skin = skin.repeat(1, LARGE, 1)[None]
    skin[..., 40:44, 4:8] = 1.0
    return skin


def test_over_exposed_skin_has_the_colour_around_and_a_white_thing_stays_white():
    true = over_exposed_skin()
    shown = true.clamp(max=1)
    lost = _over_exposed(shown, 1.0)
    known = true[0, 2, 50] <= 0.95  # where blue is not over-exposed it says all
    wrong, before = ((one - true)[0, :, 50, known].abs().max() for one in (shown + lost, shown))
    assert wrong < 0.5 * before and before > 0.4
    assert (lost[0, :, :, -1].diff(dim=0) < 0).all() and lost[..., 40:44, 4:8].max() == 0
    assert not _over_exposed(true.clamp(max=0.9), 1.0).any()


def test_over_exposed_photographs_keep_the_laws():
    photo, scene = over_exposed_skin()[0].clamp(max=1), bump()
    detail = PhotoDetail(photo, scene, FOV)
    assert (detail(scene).image[0] - photo).abs().max() <= 1 / 255
    dim = detail(scene.with_parameters(light=scene.light * torch.tensor([0.5, 0.5, 1, 1]))).image[0]
    red, _, blue = dim[:, LARGE // 3 : -LARGE // 3, -LARGE // 3 : -LARGE // 5].mean(dim=(1, 2))
    assert 1.2 < red / blue < 1.6  # 1.54 in truth, 1.0 to 1.15 in the photograph


def test_twice_the_light_doubles_what_is_not_clipped():
    photo = torch.full((3, LARGE, LARGE), 0.3)
    scene = bump()
    light = scene.light * torch.tensor([2.0, 2, 1, 1])
    seen = PhotoDetail(photo, scene, FOV)(scene.with_parameters(light=light)).image[0]
    middle = seen[:, LARGE // 3 : -LARGE // 3, LARGE // 3 : -LARGE // 3]
    # the model's colours weigh, too (DISTRUST)
    assert (middle - 0.6).abs().max() < 0.12


def test_new_light_is_nearer_to_the_truth_than_the_photograph():
    scene, other = bump(), torch.tensor([[0.3, 0.6, 0.1, -0.7]])
    photo, truth = (textured(s) for s in (scene, scene.with_parameters(light=other)))
    seen = PhotoDetail(photo, scene, FOV)(scene.with_parameters(light=other)).image[0]
    mask = (photo > 0) & (truth > 0)
    mask[:, :8] = mask[:, -8:] = mask[..., :8] = mask[..., -8:] = False
    assert (seen - truth)[mask].abs().mean() < 0.3 * (photo - truth)[mask].abs().mean()


def test_strong_new_light_keeps_fine_detail():
    """Grain of the photograph has the contrast that it has in the same light, however far light moves."""
    scene, other = bump((0.1, 0.9, 0.0, 0.8)), torch.tensor([[0.3, 0.9, 0.0, -0.9]])
    photo, truth = (textured(s) for s in (scene, scene.with_parameters(light=other)))
    seen = PhotoDetail(photo, scene, FOV)(scene.with_parameters(light=other)).image[0]

    def grain(image: torch.Tensor) -> torch.Tensor:
        smooth = avg_pool2d(image[None], 5, stride=1, padding=2)[0]
        inner = slice(LARGE // 3, -LARGE // 3)
        return (image / smooth.clamp(min=0.01))[:, inner, inner]

    assert grain(seen).std() > 0.9 * grain(truth).std()


def drawn_head(yaw_deg: float = 0.0) -> tuple[torch.Tensor, torch.Tensor]:
    """A generated head's image (3, 128, 128) and mask (128, 128)."""
    light = LIGHTS["frontal"].model_copy(update={"yaw_deg": (0, 0)})
    view = VIEWS["frontal"].model_copy(update={"yaw_deg": (yaw_deg, yaw_deg)})
    head = faces.generate(1, 128, 4, FaceSettings(light=light, view=view, backgrounds=("plain",)))
    return torch.from_numpy(head.images[0]) / 255, torch.from_numpy(head.mask[0] > 0)


def test_new_light_leaves_what_is_behind_the_object():
    (photo, object_mask), model = drawn_head(), load("rendered-faces-64")
    scene = model.decompose(avg_pool2d(photo[None], 2))
    other = scene.with_parameters(light=torch.tensor([[0.2, 1.0, 0.0, 1.2]]))
    change = (PhotoDetail(photo, scene, model.fov_deg)(other).image[0] - photo).abs().mean(dim=0)
    near = object_mask[None].float()
    behind = avg_pool2d(near, 5, stride=1, padding=2)[0] == 0
    assert change[behind].mean() < 0.01
    assert change[object_mask].mean() > 0.05


@pytest.mark.parametrize("degrees", [-30, 30])
def test_a_head_that_turns_hides_its_far_side(degrees):
    (photo, _), (turned, _) = drawn_head(), drawn_head(degrees)
    scene = load("rendered-faces-64").decompose(avg_pool2d(photo, 2)[None])
    camera = scene.camera + torch.tensor([0, math.radians(degrees), 0, 0, 0, 0])
    seen = PhotoDetail(photo, scene, FOV)(scene.with_parameters(camera=camera)).image[0]
    assert (seen - turned).square().mean() < 0.4 * (photo - turned).square().mean()


def test_turned_there_and_back_it_is_the_photograph():
    scene = bump(camera=(0.0,) * 6)
    photo = textured(scene)
    turned = scene.with_parameters(camera=torch.tensor([[0.0, math.radians(12), 0, 0, 0, 0]]))
    there = PhotoDetail(photo, scene, FOV)(turned).image[0]
    back = PhotoDetail(there, turned, FOV)(scene).image[0]
    middle = (slice(None), slice(LARGE // 4, -LARGE // 4), slice(LARGE // 4, -LARGE // 4))
    assert (back - photo)[middle].abs().mean() < 0.4 * (there - photo)[middle].abs().mean()


def test_a_photograph_in_the_mirror_is_drawn_in_the_mirror():
    scene = bump()
    photo = textured(scene)
    other = scene.with_parameters(camera=scene.camera + torch.tensor([[0.1, -0.3, 0, 0, 0, 0]]))
    seen = PhotoDetail(photo, scene, FOV)(other).image
    twin = PhotoDetail(photo.flip(-1), seen_in_mirror(scene), FOV)(seen_in_mirror(other)).image
    # `_filled` halves odd sides, so that surroundings differ a little between the twins
    assert (seen.flip(-1) - twin).abs().mean() < 0.005


def test_hidden_surface_comes_from_the_mirror_image():
    """The photograph has a colour that the model does not know; what is hidden shows it."""
    scene = bump(camera=(0.0, math.radians(40), 0.0, 0.0, 0.0, 0.0))
    photo = textured(scene.with_parameters(albedo=scene.albedo * torch.tensor([0.2, 1, 0.2])[:, None, None]))
    turned = scene.with_parameters(camera=-scene.camera)
    seen = PhotoDetail(photo, scene, FOV)(turned).image[0]
    middle = seen[:, LARGE // 3 : -LARGE // 3, LARGE // 3 : -LARGE // 3]
    assert middle[1].mean() > 2 * middle[0].mean()


def test_albedo_is_free_of_shading():
    scene = bump(light=(0.2, 0.7, 0.0, 0.6), camera=(0.0, 0.0, 0.0, 0.0, 0.0, 0.0))
    detail = PhotoDetail(textured(scene), scene, FOV)
    texture = detail.on_grid(detail.albedo(), SMALL)
    middle = (..., slice(8, -8), slice(8, -8))
    grain = 0.05  # on average
    assert (texture - scene.albedo - grain)[middle].abs().mean() < 0.05


def test_several_scenes_are_drawn_as_one_by_one():
    scene = bump()
    draw = PhotoDetail(textured(scene), scene, FOV)
    lights = torch.tensor([[0.3, 0.6, 0.1, -0.7], [0.5, 0.3, -0.2, 0.2]])
    both = draw(scene.map(lambda one: one.expand(2, *one.shape[1:])).with_parameters(light=lights)).image
    for row in range(2):
        one = draw(scene.with_parameters(light=lights[row : row + 1])).image[0]
        torch.testing.assert_close(both[row], one, atol=1e-5, rtol=0)


@pytest.mark.parametrize("photo", [torch.rand(3, 16, 16), torch.rand(3, 31, 31)])
def test_a_photograph_that_does_not_fit_is_refused(photo):
    with pytest.raises(ValueError, match="a photograph"):
        PhotoDetail(photo, bump(), FOV)


@pytest.mark.parametrize("name", ["phong+haze", "phong(gamma=2.2)", "sh", "lambert-shadow+haze"])
def test_effects_that_the_model_knows_are_taken_off_and_drawn_anew(name):
    renderer = renderer_named(name)
    extra = {"specular": torch.tensor([[0.4, 12.0]]), "haze": torch.tensor([[1.5, 0.9]])}
    wanted = {row.parameter for row in renderer.factors}
    own = {key: value for key, value in extra.items() if key in wanted}
    scene = Scene.from_parameters(bump().parameters | own)
    if "environment" in wanted:
        scene = Scene.from_parameters(scene.parameters | {"environment": from_light(scene.light)})
    noise = torch.rand(3, LARGE, LARGE, generator=torch.Generator().manual_seed(0))
    own = PhotoDetail(noise, scene, FOV, margin=0.1, renderer=renderer)
    assert (own(scene).image[0] - noise).abs().max() <= 1.5 / 255  # even where no effect explains a pixel
    if name != "phong+haze":
        return
    photo = renderer(at_size(scene, LARGE), FOV).image[0].clamp(0, 1)
    detail, inner = PhotoDetail(photo, scene, FOV, renderer=renderer), slice(LARGE // 3, -LARGE // 3)
    bare = (detail.albedo() - at_size(scene, LARGE).albedo).abs()[..., inner, inner].mean()
    with_effects = (PhotoDetail(photo, scene, FOV).albedo() - at_size(scene, LARGE).albedo).abs()
    assert bare < 0.25 * with_effects[..., inner, inner].mean()
    clear = scene.with_parameters(specular=torch.tensor([[0.0, 12.0]]), haze=torch.tensor([[0.2, 0.9]]))
    expected = renderer(at_size(clear, LARGE), FOV).image
    away = (detail(clear).image - expected).abs()[..., inner, inner].mean()
    assert away < 0.2 * (expected - photo).abs()[..., inner, inner].mean()
