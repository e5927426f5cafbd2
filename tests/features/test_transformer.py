"""DisentangledFeatures keeps scikit-learn's promises."""

import pickle

import numpy as np
import pytest
import torch
from PIL import Image
from sklearn.linear_model import LogisticRegression
from sklearn.model_selection import GridSearchCV
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import StandardScaler

import derender
from derender.features import embed_image_set
from derender.features.transformer import DisentangledFeatures


@pytest.fixture
def loads(model, monkeypatch) -> list:
    """Lets ``derender.load`` give the tiny model, and lists what was asked for."""
    asked = []

    def load(source, device="cpu"):
        asked.append((source, device))
        return model

    monkeypatch.setitem(vars(derender), "load", load)
    return asked


def test_transform_gives_the_table_s_features_in_the_order_asked_for(model, pictures):
    table = embed_image_set(model, pictures)
    features = DisentangledFeatures(model, factors=("albedo", "geometry")).fit_transform(pictures.images)
    np.testing.assert_allclose(features, table.concatenate(("albedo", "geometry")), rtol=1e-5, atol=1e-5)
    one = DisentangledFeatures(model, factors="albedo", batch_size=2).transform(pictures.images)
    np.testing.assert_allclose(one, table.factors["albedo"], rtol=1e-5, atol=1e-5)
    assert DisentangledFeatures(model, factors=None).transform(pictures.images).shape == (11, 5)


def test_every_form_of_picture_gives_the_same_features(model, pictures, tmp_path):
    images = pictures.images
    paths = [tmp_path / f"{i}.png" for i in range(len(images))]
    for path, image in zip(paths, images, strict=True):
        Image.fromarray(image.transpose(1, 2, 0)).save(path)
    transformer = DisentangledFeatures(model)
    expected = transformer.transform(images)
    last, names = images.transpose(0, 2, 3, 1), [str(path) for path in paths]
    forms = [last, images / 255, (last / 255).astype(np.float32), torch.from_numpy(images) / 255]
    for form in (*forms, list(images), paths, names, np.array(names)[:, None]):
        np.testing.assert_allclose(transformer.transform(form), expected, rtol=1e-4, atol=1e-4)


def test_images_of_several_sizes_are_one_clear_error(model, pictures):
    given = [*pictures.images[:2], pictures.images[2, :, :-1]]
    with pytest.raises(ValueError, match=r"image 2 is \(3, \d+, \d+\), image 0 .*: resize them"):
        DisentangledFeatures(model).transform(given)


def test_the_model_is_loaded_late_once_and_a_copy_carries_its_path_not_its_weights(loads, pictures):
    transformer = DisentangledFeatures("runs/x")
    assert loads == []
    result = transformer.fit(pictures.images).transform(pictures.images)
    assert loads == [("runs/x", "cpu")]
    copy = pickle.loads(pickle.dumps(transformer))
    assert "_model" not in vars(copy)
    np.testing.assert_array_equal(copy.transform(pictures.images), result)
    transformer.set_params(model="runs/y").transform(pictures.images)
    assert loads[1:] == [("runs/x", "cpu"), ("runs/y", "cpu")]


def test_it_works_in_a_pipeline_under_grid_search_with_names_and_pandas(model, pictures):
    labels = np.arange(11) % 2
    images = pictures.images.copy()
    images[labels == 1] //= 4
    pipeline = make_pipeline(DisentangledFeatures(model), StandardScaler(), LogisticRegression())
    grid = {"disentangledfeatures__factors": [("geometry",), ("geometry", "albedo")]}
    search = GridSearchCV(pipeline, grid, cv=2).fit(images, labels)
    assert search.score(images, labels) == 1.0
    names = search.best_estimator_[:-1].get_feature_names_out()
    assert names[0] == "geometry_0" and len(names) == search.best_estimator_[-1].n_features_in_
    frame = DisentangledFeatures(model).set_output(transform="pandas").fit_transform(images)
    assert list(frame.columns) == ["geometry_0", "geometry_1", "geometry_2", "albedo_0", "albedo_1"]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda images: images[:, :, :4], r"\(N, 3, 8, 8\) or \(N, 8, 8, 3\), got shape \(11, 3, 4, 8\)"),
        (lambda images: images[0], r"got shape \(3, 8, 8\)"),
        (lambda images: images.astype(np.int64), "expected images in uint8 or floats in 0..1, got int64"),
        (lambda images: images.astype(np.float32), "not in 0..1: divide by 255"),
        (lambda images: np.full((1, 3, 8, 8), np.nan), "holds values that are not finite"),
        (lambda images: "one.png", "got the one path 'one.png': give a list of paths"),
        (lambda images: [None, None], "expected paths of images, got NoneType"),
        (lambda images: np.array([["a.png", "b.png"]]), r"one path for each image, got shape \(1, 2\)"),
    ],
)
def test_wrong_images_are_refused_in_words(model, pictures, change, message):
    with pytest.raises(ValueError, match=message):
        DisentangledFeatures(model).transform(change(pictures.images))


@pytest.mark.parametrize(
    ("factors", "message"),
    [
        (("geomtry",), "unknown factor 'geomtry'; did you mean 'geometry'\\?"),
        ((), "name at least one factor; there is geometry, albedo"),
    ],
)
def test_wrong_factors_are_refused_in_words(model, factors, message):
    with pytest.raises(ValueError, match=message):
        DisentangledFeatures(model, factors=factors).fit()
