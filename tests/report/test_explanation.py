"""Overlays and tables of an explanation."""

from dataclasses import replace

import numpy as np
import torch

from derender.interpretation.attribution import Similarity
from derender.interpretation.tables import sanity_table, unchanged
from derender.report.explanation import overlays


def test_an_empty_map_leaves_a_grey_picture_and_a_full_one_lights_its_place():
    picture = torch.rand(2, 3, 32, 32, generator=torch.Generator().manual_seed(0))
    maps = torch.zeros(2, 4, 4)
    maps[1, 0, 3] = 2
    empty, lit = (np.asarray(image, np.int64) for image in overlays(picture, maps))
    grey = (picture[0].mean(dim=0) * 255).round().numpy()
    assert np.abs(empty - grey[..., None]).max() <= 1
    changed = np.abs(lit - (picture[1].mean(dim=0) * 255).round().numpy()[..., None]).max(axis=2) > 2
    assert changed[:4, 28:].all() and not changed[16:, :16].any()


def test_the_sanity_table_names_what_not_to_trust():
    rows = [
        Similarity("pixels", "light", "random weights", 0.9, 0.8, 0.1, 0.0),
        Similarity("pixels", "light", "shuffled labels", 0.2, 0.1, 0.1, 0.0),
        Similarity("grad-cam", "camera", "random weights", 0.1, 0.1, 0.1, 0.5),
        Similarity("grad-cam", "camera", "shuffled labels", 0.7, 0.1, 0.1, 0.5),
    ]
    rows += [replace(row, changed="another image") for row in rows[::2]]
    assert unchanged(rows, "random weights") == ["pixels, light"]
    assert unchanged(rows, "shuffled labels") == ["grad-cam, camera"]
    values = sanity_table(rows).values()
    assert values["pixels, light"]["changes"] == "no" and values["grad-cam, camera"]["changes"] == "yes"
    assert values["pixels, light"]["other image"] == 0.9
