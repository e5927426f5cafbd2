"""Arguments of library calls: values pass through, names and addresses are resolved, mistakes are errors."""

import numpy as np
import pytest
import torch
from PIL import Image

import derender
from derender.data import ImageSet, as_batch
from derender.inputs import as_images, as_model, device_named, part_of
from derender.storage.folder import SplitRecord, write_split


@pytest.fixture
def image_set() -> ImageSet:
    images = np.arange(20 * 3 * 8 * 8, dtype=np.uint32).astype(np.uint8).reshape(20, 3, 8, 8)
    return ImageSet(images, tuple(f"{row}.png" for row in range(20)))


@pytest.fixture
def model(tmp_path, smallest):
    return smallest.save(tmp_path / "model")


def test_values_pass_through(image_set, model):
    assert as_images(image_set, 8) is image_set
    loaded = derender.load(model)
    assert as_model(loaded) is loaded
    assert as_model(model, device="cpu").image_size == 32 and device_named("cpu") == "cpu"
    with pytest.raises(ValueError, match="choose auto, cpu or cuda"):
        device_named("gpu")


def test_an_address_is_read_at_the_size_asked_for(tmp_path):
    for row in range(3):
        Image.new("RGB", (10, 10), (40 * row, 10, 10)).save(tmp_path / f"{row}.png")
    assert as_images(tmp_path, 8).images.shape == (3, 3, 8, 8)
    assert len(as_images(tmp_path, 8, limit=2)) == 2
    with pytest.raises(ValueError, match="needs 4 images or more"):
        as_images(tmp_path, 8, at_least=4)


def test_a_file_is_decoded_alike_alone_and_in_a_folder(tmp_path):
    noise = np.random.default_rng(0).integers(0, 256, (900, 700, 3), dtype=np.uint8)
    Image.fromarray(noise).save(tmp_path / "large.jpg")
    alone = as_batch([str(tmp_path / "large.jpg"), noise], 32)
    assert torch.equal(alone[0] * 255, torch.from_numpy(as_images(tmp_path, 32).images[0]).float())
    assert alone.shape == (2, 3, 32, 32)


def test_a_part_is_that_of_the_models_split(image_set, model):
    with pytest.raises(ValueError, match="records no split"):
        part_of(image_set, "test", model)
    write_split(model, SplitRecord((0.5, 0.25, 0.25), 3))
    parts = [part_of(image_set, part, model).files for part in ("train", "validation", "test")]
    assert [len(files) for files in parts] == [10, 5, 5]
    assert sorted(sum(parts, ())) == sorted(image_set.files)
    with pytest.raises(ValueError, match="unknown part 'tst'; did you mean 'test'"):
        part_of(image_set, "tst", model)
    with pytest.raises(ValueError, match="needs a model"):
        part_of(image_set, "test", None)


def test_weights_that_are_not_finite_are_refused(model, tmp_path):
    broken = derender.load(model)
    next(iter(broken.nets["light"].parameters()))[0] = torch.nan
    with pytest.raises(ValueError, match="NaN or infinite"):
        as_model(broken.save(tmp_path / "broken"))


def test_optimisation_per_image_needs_its_maps(model):
    with pytest.raises(ValueError, match="derender whiten"):
        as_model(model, fit_steps=3)
    assert as_model(model, fit_steps=0).fitting is None
    with pytest.raises(ValueError, match="fit_steps must be 0 or more, got -1"):
        as_model("faces-64", fit_steps=-1)
