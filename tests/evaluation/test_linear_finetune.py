"""Fine-tuning learns through the encoders and leaves the model as it was."""

import numpy as np
import pytest
import torch

from derender import Derenderer
from derender.evaluation.linear_finetune import finetune
from derender.evaluation.linear_head import HeadSettings
from derender.evaluation.linear_scores import linear_scores
from derender.evaluation.linear_task import task_of


def test_bright_and_dark_pictures_are_learned_through_the_encoders():
    rng = np.random.default_rng(0)
    bright = rng.integers(0, 2, 32)
    images = (rng.integers(0, 60, (32, 3, 32, 32)) + 150 * bright[:, None, None, None]).astype(np.uint8)
    model = Derenderer.from_preset("small", seed=0, image_size=32, width=4, light_width=4).eval()
    model.requires_grad_(False)
    before = {name: value.clone() for name, value in model.state_dict().items()}
    task = task_of({"bright": bright.astype(np.int8)})
    rows, tested, done = np.arange(16), np.arange(16, 32), []
    options = {"settings": HeadSettings(learning_rate=3e-3, epochs=8, batch_size=8), "seed": 3}
    answers = finetune(
        model, images, task, rows, tested, progress=lambda at, total: done.append((at, total)), **options
    )
    assert linear_scores(task.targets[tested], answers, "labels").accuracy == 1
    assert done[-1] == (8, 8)
    assert all(torch.equal(value, before[name]) for name, value in model.state_dict().items())
    assert not any(parameter.requires_grad for parameter in model.parameters())
    again = finetune(model, images, task, rows, tested, **options)
    assert again == pytest.approx(answers, abs=1e-4)
