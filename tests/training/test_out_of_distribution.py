"""An image's percentile: known answers, and other things than faces shown to a model of faces."""

import numpy as np
import pytest

import derender
from derender.data import read_images
from derender.data.synthetic import faces
from derender.storage.places import model_folder
from derender.training import held_out_errors as kept


def test_known_percentiles():
    held_out = kept.HeldOutErrors(pictures=101, quantiles=list(np.linspace(0.1, 0.2, 101)))
    found = kept.percentile_of(np.array([0.0, 0.1, 0.15, 0.1985, 0.2, 9.0, np.inf]), held_out)
    assert found == pytest.approx([0, 0, 50, 98.5, 100, 100, 100])


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
