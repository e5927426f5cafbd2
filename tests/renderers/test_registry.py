"""Renderers by name: found, refused, recorded with a model, and chosen for a training."""

import json
import pickle

import pytest
import torch

from derender.learn import run_settings
from derender.model import Derenderer, load
from derender.networks import FACTORS
from derender.render import render_scene
from derender.renderers import RENDERERS, Renderer, recorded_renderer, renderer_named
from derender.scene import Scene
from derender.storage import places
from derender.storage.places import CONFIG_FILE, bundled_renderers
from derender.training.config import to_yaml
from derender.training.run_folder import reopen_run

TINY = {"image_size": 32, "width": 8, "light_width": 4}
ALL = "phong(gamma=2.2)+lambert-shadow(softness_deg=8)+haze"


@pytest.mark.parametrize("name", [*RENDERERS, ALL, "sh(colour=true)+haze"])
def test_a_model_is_saved_with_its_renderer_and_found_again(name, tmp_path, generator):
    model = Derenderer.from_preset("small", seed=0, renderer=name, **TINY)
    config = json.loads((model.save(tmp_path / "m") / CONFIG_FILE).read_text())
    assert config["settings"]["renderer"] == name == model.renderer.name
    result, images = load(tmp_path / "m"), torch.rand(2, 3, 32, 32, generator=generator)
    assert [row.name for row in result.factors] == config["factors"] == [row.name for row in model.factors]
    drawn = model.eval().reconstruct(images).image
    assert torch.equal(result.reconstruct(images).image, drawn)
    assert torch.equal(pickle.loads(pickle.dumps(model)).reconstruct(images).image, drawn)
    with pytest.raises(ValueError, match=r"was made with the renderer .*, not 'unheard-of'"):
        load(tmp_path / "m", renderer="unheard-of")


def test_lambert_is_found_through_the_registry_and_draws_as_the_plain_renderer(generator):
    model = Derenderer.from_preset("small", seed=0, **TINY)
    assert model.renderer == renderer_named("lambert") and model.factors == FACTORS
    scene = model.decompose(torch.rand(2, 3, 32, 32, generator=generator))
    assert torch.equal(model.render(scene).image, render_scene(scene).image)


def test_a_model_of_before_renderers_loads_as_lambert(tmp_path):
    folder = Derenderer.from_preset("small", seed=0, **TINY).save(tmp_path / "m")
    config = json.loads((folder / CONFIG_FILE).read_text())
    del config["settings"]["renderer"]
    (folder / CONFIG_FILE).write_text(json.dumps(config))
    assert load(folder).renderer.name == "lambert"


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("phon", "no renderer 'phon'; did you mean 'phong'"),
        ("phong(gama=2)", "no setting 'gama'; did you mean 'gamma'.*gamma, mean_diffuse"),
        ("phong(gamma=9)", r"gamma must lie in 1\.\.3, got 9"),
        ("phong(gamma=high)", "gamma must be a float, got 'high'"), ("phong+phong", "'phong' twice"),
        ("lambert-shadow(softness_deg=0)", r"must lie in 0\.1\.\.45"), ("phong(", "cannot read the renderer"),
        ("lambert(gamma=1)", "has no setting 'gamma': it has none"),
        ("sh+lambert-shadow", "cannot be combined: each sets the light"),
        ("nothing.here:glow", "no renderer 'nothing.here:glow'.*PYTHONPATH"),
        ("yaml:dump", "'yaml:dump' is a function, not a derender.renderers.Renderer"),
        ("this:x", "names a module of Python itself"), ("numpy.f2py.__main__:x", "or a program"),
        (".:x", "cannot read the renderer"), ("..os:x", "cannot read the renderer"),
        ("phong(gamma=" + "[" * 180 + ")", "more than 50 levels"),
        ("phong(gamma=" + "9" * 400 + ")", r"must lie in 1\.\.3, got inf"),
        ("phong(gamma=!!python/name:os.system)", "could not determine a constructor"),
    ],
)  # fmt: skip
def test_a_name_that_is_none_says_what_to_write(name, message):
    with pytest.raises(ValueError, match=message):
        renderer_named(name)


def test_a_users_module_is_imported_except_for_a_downloaded_model(tmp_path, monkeypatch):
    text = "from derender.renderers import Renderer\nGLOW = Renderer('glow', gamma=2.0)\n"
    (tmp_path / "my_glow.py").write_text(text)
    monkeypatch.syspath_prepend(str(tmp_path))
    name = "my_glow:GLOW"
    folder = Derenderer.from_preset("small", seed=0, renderer=name, **TINY).save_pretrained(tmp_path / "m")
    assert f"light and camera, drawn by the renderer `{name}`." in (folder / "README.md").read_text()
    with pytest.raises(ValueError, match=r"someone/model was downloaded and wants the code .*my_glow:GLOW"):
        recorded_renderer(name, None, "someone/model")
    for given in (name, Renderer("glow", gamma=2.0)):
        assert recorded_renderer(name, given, "someone/model") == load(folder).renderer


@pytest.mark.parametrize("line", ["raise RuntimeError('no')", "import sys; sys.exit(3)", "1 / 0", "def"])
def test_a_module_that_fails_or_ends_the_program_is_one_line(line, tmp_path, monkeypatch):
    name = f"fails_{abs(hash(line))}"
    (tmp_path / f"{name}.py").write_text(line)
    monkeypatch.syspath_prepend(str(tmp_path))
    with pytest.raises(ValueError, match=rf"no renderer '{name}:x' \([A-Z]\w+\("):
        renderer_named(f"{name}:x")


def test_settings_of_a_run_name_renderer_and_factors():
    config = run_settings(preset="small", renderer="phong+haze", loocc="light+specular")
    assert config.model.renderer == "phong+haze" and config.objective.loocc == "light+specular"
    assert run_settings(settings={"renderer": "sh"}).model.renderer == "sh"
    with pytest.raises(ValueError, match=r"'specular' is no factor that this model perturbs.*light, camera"):
        run_settings(loocc="light+specular")
    with pytest.raises(ValueError, match="no renderer 'phng'; did you mean 'phong'"):
        run_settings(renderer="phng")
    with pytest.raises(ValueError, match="made with the renderer 'lambert', not 'haze'"):
        run_settings(renderer="haze", start_from="faces-64")


def test_a_run_is_resumed_with_its_renderer(tmp_path):
    (tmp_path / "config.yaml").write_text(to_yaml(run_settings(preset="small", renderer="phong+haze")))
    with pytest.raises(ValueError, match=r"trained with another model\.renderer \(phong\+haze, now haze\)"):
        reopen_run(tmp_path, run_settings(preset="small", renderer="haze"), {})


def _scene(**extra) -> Scene:
    maps, light = (torch.ones(1, 8, 8), torch.ones(1, 3, 8, 8)), torch.tensor([[0.5, 0.5, 0, 0]])
    return Scene(*maps, light, torch.zeros(1, 6), extra)


def test_a_renderer_refuses_scenes_that_are_not_its_own():
    phong = renderer_named("phong")
    with pytest.raises(ValueError, match=r"renderer 'phong' needs the scene's 'specular'.*another renderer"):
        phong(_scene(), 10.0)
    with pytest.raises(ValueError, match=r"exponent must lie in 1\.\.128 for the renderer 'phong', got 300"):
        phong(_scene(specular=torch.tensor([[0.1, 300.0]])), 10.0)
    broken = Renderer("mine", specular=lambda scene, normal, fov_deg: normal[None, ..., 0, 0].log() - 9)
    with pytest.raises(ValueError, match="renderer 'mine' makes NaN or infinity of finite scenes"):
        broken(_scene(), 10.0)


def test_a_file_with_a_function_of_its_name_is_a_renderer(tmp_path, monkeypatch):
    """One new file is all: names, errors and help read this list."""
    assert set(bundled_renderers()) == set(RENDERERS)
    (tmp_path / "renderers").mkdir()
    for file, function in {"mirror_ball": "mirror_ball", "tools": "other"}.items():
        (tmp_path / "renderers" / f"{file}.py").write_text(f"\ndef {function}():\n")
    monkeypatch.setattr(places, "__file__", str(tmp_path / "storage" / "places.py"))
    assert bundled_renderers() == {"mirror-ball": "mirror_ball"}
