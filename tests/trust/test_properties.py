"""Laws that hold whatever the numbers are: scale, order, names and mirror images."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from sklearn.metrics import adjusted_rand_score

from derender.evaluation.clustering_methods import clusterings
from derender.evaluation.clustering_scores import cluster_scores
from derender.evaluation.linear_probes import probe
from derender.evaluation.linear_task import task_of
from derender.model import Derenderer
from derender.objectives.reconstruction import depth_smoothness, masked_l1, photometric_loss
from derender.render import render
from derender.scene import Scene
from derender.scene.scene import seen_in_mirror

METHODS = ("ward", "finch", "k-means")


def rows_of(count: int = 60, width: int = 5, groups: int = 3) -> np.ndarray:
    """Groups that overlap, of clear numbers: no tie decides."""
    numbers = np.random.default_rng(3)
    return numbers.normal(size=(count, width)) + 3 * np.eye(width)[np.arange(count) % groups]


ORDERED = np.ascontiguousarray(rows_of()[:, ::-1] * np.array([1, -1, 1, -1, -1]))


@pytest.mark.parametrize(
    ("method", "changed"),
    [
        *((method, factor * rows_of()) for method in METHODS for factor in (1e-3, 7.0, 4096.0)),
        *((method, ORDERED) for method in METHODS),
        *((method, rows_of() + 5.0) for method in ("ward", "k-means")),
    ],
)
def test_clusters_see_no_scale_no_order_or_signs_of_dimensions_and_no_origin(method, changed):
    plain, other = clusterings(rows_of(), (3, 5), method), clusterings(changed, (3, 5), method)
    for count in (3, 5):
        assert adjusted_rand_score(plain[count], other[count]) == 1


@settings(deadline=None)
@given(
    st.lists(st.tuples(st.integers(0, 3), st.integers(0, 3)), min_size=1, max_size=30),
    st.permutations(range(4)),
)
def test_two_sided_scores_do_not_care_which_side_is_which(pairs, names):
    """NMI, ARI and the matched share are symmetric, and a class's name is no number."""
    one, other = (np.array(side) for side in zip(*pairs, strict=True))
    straight, crossed = cluster_scores(one, other), cluster_scores(other, one)
    renamed = cluster_scores(np.array(names)[one], other)
    for name in ("nmi", "ari", "hungarian"):
        assert crossed[name] == pytest.approx(straight[name], abs=1e-12)
        assert renamed[name] == pytest.approx(straight[name], abs=1e-12)
    assert renamed["accuracy"] == pytest.approx(straight["accuracy"])


SCALES = np.array([1e-2, 1, 64, 5, 1e3], np.float32)
ROWS = rows_of(80).astype(np.float32)


@pytest.mark.parametrize(
    ("head", "changed"),
    [
        *((head, rows) for head in ("logistic", "k-NN") for rows in (256 * ROWS, ROWS[:, ::-1])),
        ("logistic", ROWS * SCALES),
    ],
)
def test_probes_see_no_scale_of_features_and_no_order_of_dimensions(head, changed):
    """The paper's head sees both: it is trained for a few steps on features as they are."""
    task = task_of({"group": np.array(list("abc"))[np.arange(80) % 3]})
    learned, tested = np.arange(40)[None], np.arange(40, 80)
    plain, other = (probe(head, rows, task, learned, tested, (0,)) for rows in (ROWS, changed))
    np.testing.assert_allclose(other, plain, atol=2e-4)


def bumpy_scene(count: int = 3, height: int = 14, width: int = 17) -> list[torch.Tensor]:
    """Depth, albedo, light and camera that no mirror leaves alone."""
    numbers = torch.Generator().manual_seed(1)
    y, x = torch.meshgrid(torch.linspace(-1, 1, height), torch.linspace(-1, 1, width), indexing="ij")
    depth = 1 + 0.03 * torch.sin(2 * x + y) + 0.02 * x[None] * torch.rand(count, 1, 1, generator=numbers)
    albedo = torch.rand(count, 3, height, width, generator=numbers)
    light = torch.rand(count, 4, generator=numbers) * torch.tensor([0.5, 0.5, 0.4, 0.4])
    camera = 0.2 * torch.rand(count, 6, generator=numbers) - 0.1
    return [value.double() for value in (depth, albedo, light, camera * torch.tensor([1, 1, 1, 0.1, 0.1, 0]))]


def test_a_mirrored_scene_costs_what_the_scene_costs():
    """Every loss of an image and its scene is that of their mirror images, but for the cells' diagonals."""
    scene = bumpy_scene()
    twin_scene = seen_in_mirror(Scene(*scene)).parameters.values()
    picture = torch.rand(3, 3, 14, 17, dtype=torch.float64, generator=torch.Generator().manual_seed(2))
    sigma = torch.rand(3, 1, 14, 17, dtype=torch.float64, generator=torch.Generator().manual_seed(3)) + 0.1
    straight, twin = render(*scene, backend="reference"), render(*twin_scene, backend="reference")
    both = straight.mask * twin.mask.flip(-1)
    assert both.mean() > 0.5
    assert float(((straight.image - twin.image.flip(-1)).abs().amax(1) * both).max()) < 0.02
    for loss in (lambda image, target, mask, spread: masked_l1(image, target, mask), photometric_loss):
        one = loss(straight.image, picture, both, sigma)
        other = loss(twin.image, picture.flip(-1), both.flip(-1), sigma.flip(-1))
        assert float(one) == pytest.approx(float(other), rel=2e-3)
    for order in (1, 2):
        one, other = (float(depth_smoothness(depth, order=order)) for depth in (scene[0], scene[0].flip(-1)))
        assert one == pytest.approx(other, rel=1e-12)


def test_a_model_mirrors_maps_and_nothing_else_and_twice_is_once():
    model = Derenderer.from_preset("small", seed=0, image_size=32, width=4, light_width=4, code_size=16)
    with torch.no_grad():
        scene = model.decompose(torch.rand(2, 3, 32, 32, generator=torch.Generator().manual_seed(0)))
    twin, back = model.mirror(scene), model.mirror(model.mirror(scene))
    for name, value in scene.parameters.items():
        assert torch.equal(back.parameters[name], value)
        expected = value.flip(-1) if name in ("depth", "albedo") else value
        assert torch.equal(twin.parameters[name], expected)
