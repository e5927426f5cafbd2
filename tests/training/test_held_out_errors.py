"""Errors of held-out images: measured as by the evaluation, kept with the model; other things than faces."""

import json
from types import SimpleNamespace

import numpy as np
import pytest
import torch

import derender
from derender import Derenderer
from derender.data import read_images
from derender.data.synthetic import faces
from derender.evaluation import reconstruction_scores
from derender.storage.places import model_folder
from derender.training import held_out_errors as kept
from derender.training.held_out_errors import HeldOutErrors, errors_of, read_errors, reconstruction_errors


class Darker(torch.nn.Module):
    """Renders every image a fifth darker, its left half only; black images not at all."""

    device = torch.device("cpu")

    def reconstruct(self, images):
        mask = torch.zeros_like(images[:, 0])
        mask[:, :, : images.shape[-1] // 2] = 1
        mask = mask * (images.amax(dim=(1, 2, 3)) > 0).float()[:, None, None]
        return SimpleNamespace(image=0.8 * images, mask=mask)


@pytest.fixture
def pixels() -> np.ndarray:
    return np.random.default_rng(0).integers(0, 256, (30, 3, 32, 32), dtype=np.uint8)


def test_errors_are_those_of_the_evaluation(pixels):
    result = reconstruction_errors(Darker(), pixels, batch_size=7)
    target = torch.from_numpy(pixels).float() / 255
    rendering = Darker().reconstruct(target)
    assert result == pytest.approx(reconstruction_scores(rendering.image, target, rendering.mask).l1_each)
    assert result[0] == pytest.approx(0.2 * target[0, :, :, :16].mean().item())


def test_an_image_into_which_nothing_is_rendered_counts_as_infinitely_wrong(pixels):
    pixels[3] = 0
    assert np.isinf(reconstruction_errors(Darker(), pixels)[3])
    assert errors_of(Darker(), pixels).pictures == 29


def test_quantiles_survive_the_file(pixels, tmp_path):
    errors, each = errors_of(Darker(), pixels), reconstruction_errors(Darker(), pixels)
    ends = [each.min(), np.median(each), each.max()]
    assert errors.quantiles[::50] == pytest.approx(ends, rel=1e-5)
    kept.write_errors(tmp_path, errors)
    again = read_errors(tmp_path)
    assert again == errors and again.pictures == 30


def test_errors_are_stored_with_a_model_and_go_when_it_is_saved_anew(pixels, tmp_path):
    net = Derenderer.from_preset("small", seed=0, image_size=32, width=4, light_width=4)
    folder = net.save(tmp_path / "model")
    with pytest.raises(ValueError, match="errors need 20 images or more"):
        errors_of(Darker(), pixels[:19])
    for count in (19, 20):
        kept.store_errors(folder, pixels[:count])
        assert (read_errors(folder) is not None) == (count == 20)
    Derenderer.from_preset("small", image_size=32, width=4).save(folder, overwrite=True)
    assert read_errors(folder) is None


@pytest.mark.parametrize("damage", ["", "{", '{"format": 1}', "backwards", "newer"])
def test_a_damaged_file_says_how_to_make_it_again(tmp_path, damage):
    file = kept.write_errors(tmp_path, HeldOutErrors(pictures=50, quantiles=list(np.linspace(0, 1, 101))))
    values = json.loads(file.read_text())
    changed = {"backwards": {"quantiles": values["quantiles"][::-1]}, "newer": {"format": 2}}
    file.write_text(json.dumps(values | changed[damage]) if damage in changed else damage)
    with pytest.raises(ValueError, match="evaluate reconstruction --store"):
        read_errors(tmp_path)


def test_known_percentiles():
    held_out = kept.HeldOutErrors(pictures=101, quantiles=list(np.linspace(0.1, 0.2, 101)))
    result = kept.percentile_of(np.array([0.0, 0.1, 0.15, 0.1985, 0.2, 9.0, np.inf]), held_out)
    assert result == pytest.approx([0, 0, 50, 98.5, 100, 100, 100])


def test_rendered_faces_are_known_to_the_bundled_model_and_cars_are_not(shared_data):
    net = derender.load("rendered-faces-64")
    held_out = kept.read_errors(model_folder("rendered-faces-64"))
    assert held_out is not None
    morphable = read_images(f"{shared_data('data/synface64.zip')}::test_gt", 64, limit=48).images
    heads = np.concatenate([morphable, faces.generate(48, seed=3).images])  # both families of its training
    cars = read_images(str(shared_data("data/syncar64.zip")), 64, limit=24).images
    assert np.median(kept.reconstruction_percentile(net, heads, held_out)) == pytest.approx(50, abs=20)
    assert (kept.reconstruction_percentile(net, cars, held_out) > kept.OUTLIER_PERCENTILE).all()
    assert kept.errors_of(net, heads).quantiles[50] == pytest.approx(held_out.quantiles[50], rel=0.15)
