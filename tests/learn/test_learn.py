"""The library calls that make models, on values and on addresses, without a command."""

from dataclasses import replace

import numpy as np
import pytest
from tests.training.conftest import noise_set

import derender
from derender.data import ImageSet
from derender.inputs import split_of
from derender.learn import finetune_settings, run_settings

TINY = {
    "image_size": 32, "width": 4, "light_width": 4, "batch_size": 8, "perceptual": "none", "images": 16,
    "whitening.pictures": 8, "whitening.views": 1, "fitting.examples": 8,
}  # fmt: skip


@pytest.fixture(scope="module")
def images() -> ImageSet:
    return replace(noise_set(40), labels={"bright": np.arange(40) % 2})


@pytest.fixture(scope="module")
def run(images, tmp_path_factory):
    out = tmp_path_factory.mktemp("learn") / "run"
    phases = set()
    how = {"device": "cpu", "progress": lambda at: phases.add(at.phase)}
    result = derender.train(images, out=out, preset="small", settings=TINY, **how)
    assert (result.images, result.stopped) == (16, "images") and phases == {"train", "features"}
    return out


def test_a_run_is_a_model_with_a_page_and_goes_on(run, images):
    assert "made by the test" not in run.name and (run / "report.html").is_file()
    assert derender.load(run).whitening is not None
    more = derender.train(images, out=run, resume=True, device="cpu")
    assert more.images == 16, "its own settings: there is nothing to do"
    with pytest.raises(ValueError, match=r"on 40 images .*not on these 30 .*start_from"):
        derender.train(images.select(slice(30)), out=run, resume=True, device="cpu")
    for others in (replace(images, images=255 - images.images), replace(images, files=images.files[::-1])):
        with pytest.raises(ValueError, match=r"on 40 images .*not on these 40"):
            derender.train(others, out=run, resume=True, device="cpu")
    with pytest.raises(FileExistsError, match="is not empty"):
        derender.train(images, out=run, settings=TINY)
    with pytest.raises(FileNotFoundError, match="train without resume first"):
        derender.train(images, out=run / "none", resume=True)


def test_a_copy_is_made_of_a_model_or_of_its_place(run, images, tmp_path):
    changes = {"whitening.pictures": 12, "whitening.views": 1, "fitting.examples": 8}
    given = derender.load(run).save_pretrained(tmp_path / "given", data="heads", licence="MIT")
    assert split_of(given) == split_of(run) is not None, "shared as it was loaded, it keeps the run's split"
    one = derender.whiten(derender.load(run), images, out=tmp_path / "one", settings=changes)
    two = derender.whiten(run, images, out=tmp_path / "two", settings=changes)
    assert one.values()["between_over_within"] == two.scores["between_over_within"]
    assert one.images == 40 and derender.load(one.folder).whitening is not None
    with pytest.raises(FileExistsError, match="overwrite=True"):
        derender.whiten(run, images, out=tmp_path / "one")
    with pytest.raises(FileExistsError, match="its files would be lost"):  # neither a run nor photographs
        derender.whiten(run, images, out=run, overwrite=True)


def test_settings_are_resolved_in_one_order(tmp_path):
    (tmp_path / "some.yaml").write_text("preset: small\nimages: 48\nseed: 3\n")
    chosen = run_settings(config=tmp_path / "some.yaml", settings={"seed": 4}, loocc="light")
    assert (chosen.preset, chosen.images, chosen.seed, chosen.objective.loocc) == ("small", 48, 4, "light")
    assert run_settings(device="cpu").preset == "small"
    assert run_settings(device="cpu", start_from="cars-64").preset == "faces"
    with pytest.raises(ValueError, match="loocc is for derender models"):
        run_settings(model="vqvae", loocc="light")
    with pytest.raises(ValueError, match="give either labels or attributes"):
        finetune_settings(tmp_path)
    joint = finetune_settings(tmp_path, labels=["bright"], factors="light, camera", preset="small")
    assert joint.target.factors == ("light", "camera")
    with pytest.raises(FileNotFoundError, match="no run to resume"):
        finetune_settings(tmp_path, labels=["bright"], resume=True)
