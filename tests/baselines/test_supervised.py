"""ResNet-18 is ResNet-18, learns labels from few images, and looks at no others."""

import numpy as np
import pytest
import torch

from derender.baselines import load_baseline, read_any_config, supervised, train_baseline
from derender.data import split_indices
from derender.features import embed_image_set, model_fingerprint
from derender.inputs import split_of
from derender.training.config import with_changes
from derender.training.run_folder import read_metrics

FEW = supervised.SupervisedConfig(
    labels=("side",),  # which a flip would change
    labelled=24,
    image_size=32,
    width=8,
    epochs=6,
    batch_size=8,
    augment=supervised.MILD.model_copy(update={"flip": 0.0}),
)


def test_it_has_the_parameters_of_resnet18():
    settings = supervised.Resnet18Settings(classes={"kind": tuple(map(str, range(1000)))})
    with torch.device("meta"):
        model = supervised.Resnet18(settings)
    assert sum(value.numel() for value in model.parameters()) == 11_689_512


def test_it_learns_from_few_labels_and_repeats(blobs, tmp_path):
    state = torch.random.get_rng_state()
    result = supervised.Resnet18.train_into(FEW, blobs, tmp_path / "run")
    assert torch.equal(torch.random.get_rng_state(), state)
    losses = [row["loss"] for row in read_metrics(tmp_path / "run") if row["kind"] == "train"]
    assert len(losses) == 18 and np.mean(losses[-3:]) < 0.6 * np.mean(losses[:3])
    model = load_baseline(tmp_path / "run", "resnet18")
    assert split_of(tmp_path / "run" / "model") == split_of(tmp_path / "run") is not None
    assert read_any_config(tmp_path / "run") == FEW and result.images == 144
    assert model.settings.classes == {"side": ("0", "1")}
    test = blobs.select(split_indices(blobs.files, FEW.split, seed=0).test)
    assert set(supervised.accuracy(model, test)) == {"accuracy side"}
    model.choose(("pooled", "logits"))
    table = embed_image_set(model, blobs)
    assert {name: values.shape[1] for name, values in table.factors.items()} == {"pooled": 64, "logits": 2}
    other = blobs.select(np.arange(48))
    hidden = sorted(set(range(48)) - set(supervised.labelled_rows(blobs, FEW).tolist()))
    other.images[hidden] = 0
    supervised.Resnet18.train_into(FEW, other, tmp_path / "other")
    assert model_fingerprint(load_baseline(tmp_path / "other")) == model_fingerprint(model)


def test_ctrl_c_tells_what_is_left(blobs, tmp_path):
    def stop(_):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt, match=r"run has settings and losses but no model: train again"):
        train_baseline(FEW, blobs, tmp_path / "run", progress=stop)


def test_accuracy_counts_right_answers_among_known_labels(blobs):
    classes = {"side": ("0", "1"), "shade": ("dark", "light")}
    model = supervised.Resnet18(supervised.Resnet18Settings(image_size=32, width=4, classes=classes))
    with torch.no_grad():
        model.net.classifier[-1].weight.zero_()
        model.net.classifier[-1].bias.copy_(torch.tensor([0.0, 1.0, 1.0, 0.0]))  # always 1, always dark
    given = blobs.select(np.arange(10))
    given.labels["shade"][:] = ["dark", "light", "", "", "", "", "", "", "", ""]
    assert supervised.accuracy(model, given) == {"accuracy side": 0.5, "accuracy shade": 0.5}


def test_labelled_rows_are_of_the_training_part_and_known(blobs):
    rows = supervised.labelled_rows(blobs, FEW)
    assert len(set(rows.tolist())) == 24
    assert set(rows.tolist()) <= set(split_indices(blobs.files, seed=0).train.tolist())
    more = supervised.labelled_rows(blobs, FEW.model_copy(update={"labelled": 30}))
    assert more[:24].tolist() == rows.tolist()
    assert supervised.labelled_rows(blobs, FEW.model_copy(update={"seed": 1})).tolist() != rows.tolist()
    gaps = blobs.select(np.arange(48))
    gaps.labels["shade"][rows] = ""
    config = FEW.model_copy(update={"labels": ("shade",), "labelled": 14})
    assert not set(supervised.labelled_rows(gaps, config).tolist()) & set(rows.tolist())


def test_every_label_has_its_own_classes(blobs):
    names, targets = supervised.encode_labels(blobs, ("shade", "side"), np.array([3, 0]))
    assert names == {"shade": ("dark", "light"), "side": ("0", "1")}
    assert targets.tolist() == [[1, 1], [0, 0]]
    model = supervised.Resnet18(supervised.Resnet18Settings(image_size=32, width=4, classes=names))
    images = torch.rand(2, 3, 32, 32)
    logits, parts = model.describe(images)["logits"], model.label_logits(images)
    assert logits.shape == (2, 4) and [part.shape for part in parts] == [(2, 2), (2, 2)]


def test_bad_labels_are_refused_before_a_folder_is_made(blobs, tmp_path):
    known = "name a label to learn, as in --set labels=NAME; the images have side, shade, same"
    for change, message in [
        ("labels=[]", known),
        ("labels=sid", "no label 'sid'; did you mean 'side'"),
        ("labelled=39", r"39 labelled images were requested, the training part has 38 with side"),
        ("labels=same", "label 'same' has one value only"),
    ]:
        with pytest.raises(ValueError, match=message):
            supervised.Resnet18.train_into(with_changes(FEW, [change]), blobs, tmp_path / "run")
    assert not (tmp_path / "run").exists()
