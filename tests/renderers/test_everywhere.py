"""Features, fitting, panels, swaps and meshes of a model whose renderer has further factors."""

import numpy as np
import pytest
import torch

import derender
from derender.model import Derenderer
from derender.photo.edit import open_photograph
from derender.photo.frame import Frame
from derender.report.decomposition import decompose_images
from derender.report.edits import relit, relit_video, swapped_factors
from derender.report.mesh import model_mesh
from derender.report.opening import OpenedImage
from derender.training.config import FeatureSettings
from derender.training.features import make_features

SIZE = 32
RENDERERS = ("phong+haze", "sh")


@pytest.fixture(scope="module", params=RENDERERS)
def model(request) -> Derenderer:
    """An untrained model with whitening and fitting of noise."""
    sizes = {"image_size": SIZE, "width": 4, "light_width": 4}
    net = Derenderer.from_preset("small", seed=0, renderer=request.param, **sizes)
    images = torch.rand(12, 3, SIZE, SIZE, generator=torch.Generator().manual_seed(0))
    few = {"whitening": {"pictures": 12}, "fitting": {"examples": 12, "coordinates": 4}}
    settings = FeatureSettings.model_validate(few)
    return make_features(net.eval().requires_grad_(False), images, settings)


def test_features_and_fitted_scenes_hold_further_factors(model, generator):
    images = torch.rand(3, 3, SIZE, SIZE, generator=generator)
    assert {row.name for row in model.factors} == set(model.embed(images))
    result, start = model.fit_scenes(images, 12), model.decompose(images)
    assert (result.after < result.before).all()
    extra = {name for name in result.scene.parameters if name not in ("depth", "albedo", "light", "camera")}
    assert extra == ({"environment"} if model.renderer.name == "sh" else {"specular", "haze"})
    for name in extra:
        moved = (result.scene.extra[name] - start.extra[name]).abs().amax(dim=1)
        assert (moved > 1e-3).all()
    model.renderer.check(result.scene)
    alone = model.fit_scenes(images[1:2], 12).scene
    together = result.scene[1].parameters
    assert all(torch.equal(value, together[name]) for name, value in alone.parameters.items())


def test_panels_swaps_relighting_and_meshes_show_further_factors(model, generator, tmp_path):
    images = torch.rand(2, 3, SIZE, SIZE, generator=generator)
    scene, shown = model.decompose(images), decompose_images(model, images)
    assert set(model.renderer.maps) < set(shown.columns)
    written = shown.write(tmp_path, {})
    for row in model.factors:
        for column, number in enumerate(row.numbers):
            own = float(scene.parameters[row.parameter][0, column])
            assert written[row.name][number.name] == pytest.approx(own)
    whole = Frame.centred(SIZE, SIZE)
    opened = ((tmp_path / str(at), as_bytes(images[at]), whole, {}, scene[at]) for at in range(2))
    one, other = (OpenedImage(*each, model.render, None, (0.9, 1.1)) for each in opened)
    swaps = swapped_factors(model, one, other)
    assert list(swaps.stills) == [f"its {row.name}" for row in model.factors]
    drawn = {np.asarray(one).tobytes() for one in (*swaps.stills.values(), swaps.inputs["reconstruction"])}
    assert len(drawn) == len(swaps.stills) + 1  # every factor changes the image
    parameter = next(row.parameter for row in model.factors if row.name == "light")
    last = list(relit(model, one, like=other).numbers.values())[-1]
    assert last[parameter] == pytest.approx(scene.parameters[parameter][1].tolist())
    assert len(model_mesh(model, scene[:1]).faces) > 100
    photo = open_photograph(as_bytes(images[0]).transpose(1, 2, 0), model, fit_steps=0)
    light = scene[1].lighting
    assert list(light) == [parameter]
    relit_like = derender.relight(images[0], model, like=images[1], fit_steps=0)
    expected = torch.from_numpy(photo.edited(**light)).permute(2, 0, 1) / 255
    torch.testing.assert_close(relit_like, expected, atol=0.01, rtol=0)
    moved = relit_video(scene, reach_deg=60, pitch_deg=0, strength=1, like=other, hold=True)
    assert torch.equal(moved[parameter], light[parameter].expand(2, -1))


def as_bytes(image: torch.Tensor) -> np.ndarray:
    return (255 * image).round().byte().numpy()
