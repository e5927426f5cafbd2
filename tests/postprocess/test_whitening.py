"""Whitening: planted nuisance goes, planted identity stays; units and rank are as documented."""

import numpy as np
import pytest
import torch
from safetensors.torch import save_file

from derender.postprocess.whitening import Scatter, Whitening, fit_projection, fit_side_by_side

VIEWS, IMAGES, SIZE = 5, 400, 12


def planted(seed: int = 0) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Codes in which axes 0..2 tell the image and axes 3..5, far larger, how it was lit, mixed by a rotation.

    Gives codes (views, images, size), the directions of the image's and of the light's axes.
    """
    generator = torch.Generator().manual_seed(seed)
    codes = 0.05 * torch.randn(VIEWS, IMAGES, SIZE, generator=generator)
    codes[..., :3] += torch.randn(1, IMAGES, 3, generator=generator)
    codes[..., 3:6] += 10 * torch.randn(VIEWS, IMAGES, 3, generator=generator)
    rotation = torch.linalg.qr(torch.randn(SIZE, SIZE, generator=generator))[0]
    return codes @ rotation, rotation[:3], rotation[3:6]


@pytest.fixture(scope="module")
def codes() -> torch.Tensor:
    return planted()[0]


def fitted(codes, directions, shrinkage=0.0, **how):
    return fit_projection(Scatter().add(codes), directions, shrinkage, **how)


def test_directions_of_lighting_shrink_and_discriminative_ones_are_kept():
    codes, told, lit = planted()
    result = fitted(codes, 3, 1e-6)
    assert ((told @ result.map).norm(dim=1) > 10).all()  # 1 of identity is 20 times what views move there
    assert ((lit @ result.map).norm(dim=1) < 0.2).all()
    every = fitted(codes, SIZE, 1e-6).ratios
    assert len(every) == SIZE
    assert every[:3].min() > 100 > 1 > every[3:].max()
    torch.testing.assert_close(result.ratios, every[:3])


def test_renderings_of_one_image_differ_by_one_in_every_kept_direction(codes):
    result = fitted(codes, 5)
    features = (codes - result.mean) @ result.map
    within = (features - features.mean(dim=0)).flatten(0, 1)
    values = torch.linalg.eigvalsh(within.T @ within / (IMAGES * (VIEWS - 1)))
    assert values[-5:] == pytest.approx(np.ones(5), abs=4e-3)
    assert values[:-5].abs().max() < 1e-4
    assert torch.linalg.matrix_rank(result.map, rtol=1e-4) == 5


def test_at_evenness_one_images_differ_alike_in_every_kept_direction(codes):
    codes = codes.double()
    for evenness in (0.0, 0.5, 1.0):
        result = fitted(codes.float(), 5, evenness=evenness)
        features = (codes - result.mean) @ result.map.double()
        within = (features - features.mean(dim=0)).flatten(0, 1)
        total = within.T @ within / (IMAGES * (VIEWS - 1)) + torch.cov(features.mean(0).T, correction=0)
        variances = torch.linalg.eigvalsh(total)[-5:].numpy()
        expected = (1 + result.ratios.double()) ** (1 - evenness) * 2**evenness
        assert variances == pytest.approx(expected.sort().values.numpy(), rel=1e-3)


def test_directions_count_by_how_much_of_them_is_the_images_own(codes):
    spread = Scatter().add(codes)
    plain, weighted = fit_projection(spread, 3, 0.1), fit_projection(spread, 3, 0.1, power=2)
    matrices = ((result.map.T @ spread.between.float() @ result.map) for result in (plain, weighted))
    kept, shrunk = (torch.linalg.eigvalsh(matrix).flip(0)[:3] for matrix in matrices)
    own = plain.ratios / (1 + plain.ratios)
    torch.testing.assert_close(shrunk, kept * own**4, rtol=1e-3, atol=1e-5)


def test_activations_longer_than_the_code_give_features_of_its_size_and_distinguish_more():
    told, _, _ = planted(0)
    code, _, lit = planted(1)
    code = code - code @ lit.T @ lit  # the code itself is distinguished by other images' axes
    both = torch.cat([code, told], dim=2)
    result = fitted(both, 6, 1e-6, size=SIZE)
    assert result.map.shape == (2 * SIZE, SIZE)
    features = (both - result.mean) @ result.map
    assert torch.linalg.matrix_rank(features.flatten(0, 1), rtol=1e-4) == 6
    within = (features - features.mean(dim=0)).flatten(0, 1)
    assert torch.linalg.eigvalsh(within.T @ within)[-6:].max() < 1.1 * IMAGES * (VIEWS - 1)
    assert (features.mean(dim=0)[:, None] - features.mean(dim=0)).norm(dim=2).median() > 20


def test_features_stand_in_the_place_of_the_code_that_they_are_nearest_to():
    generator = torch.Generator().manual_seed(0)
    own = torch.randn(1, 200, 4, generator=generator) * torch.tensor([0.6, 1.2, 1.8, 2.4])
    codes = own + 0.1 * torch.randn(3, 200, 4, generator=generator)
    result = fitted(codes, 4)
    features = ((codes - result.mean) @ result.map).flatten(0, 1)
    together = torch.corrcoef(torch.cat([codes.flatten(0, 1), features], dim=1).T)[:4, 4:]
    assert (together.diagonal() > 0.95).all()
    assert (together - torch.diag(together.diagonal())).abs().max() < 0.3


def test_activations_side_by_side_weigh_alike_in_features_of_their_own(codes):
    both = [Scatter().add(codes), Scatter().add(100 * codes[..., :3])]
    result = fit_side_by_side(both, 4, 0.1, 5, 0.0)
    own = result.map.double()
    parts = zip(both, (own[:SIZE, :2], own[SIZE:, 2:]), strict=True)
    first, second = ((part.T @ (one.within + one.between) @ part).trace() for one, part in parts)
    torch.testing.assert_close(second, first, rtol=1e-5, atol=0)
    assert not result.map[:SIZE, 2:].any() and not result.map[SIZE:, :2].any()
    alone = fit_projection(both[0], 4, 0.1, 5, 0.0)
    torch.testing.assert_close(fit_side_by_side(both[:1], 4, 0.1, 5, 0.0).map, alone.map)


def test_codes_that_never_move_are_survived_and_too_few_refused():
    codes = torch.zeros(3, 10, 4)
    result = fitted(codes, 2, 0.1)
    assert torch.isfinite(result.map).all() and ((codes - result.mean) @ result.map).abs().max() == 0
    for few in (codes[:1], codes[:, :1]):
        with pytest.raises(ValueError, match="at least 2 views of 2 images"):
            fitted(few, 2, 0.1)


def test_sums_over_batches_are_those_of_all_at_once(codes):
    whole, parts = Scatter().add(codes), Scatter()
    for batch in codes.split(37, dim=1):
        parts.add(batch)
    apart = codes.double() - codes.double().mean(dim=0)
    within = torch.einsum("vni,vnj->ij", apart, apart) / (codes.shape[1] * (len(codes) - 1))
    between = torch.cov(codes.double().mean(dim=0).T, correction=0)
    for result in (whole, parts):
        torch.testing.assert_close(result.within, within, rtol=1e-4, atol=1e-6)
        torch.testing.assert_close(result.between, between, rtol=1e-6, atol=1e-9)


def test_mirrored_maps_take_the_mean_of_both_readings_and_all_of_them(codes):
    result, (own, mirror) = fitted(codes, 3, 0.1), codes[:2]
    plain, both = Whitening({"geometry": result}), Whitening({"geometry": result}, mirrored=["geometry"])
    expected = (plain({"geometry": own})["geometry"] + plain({"geometry": mirror})["geometry"]) / 2
    got = both({"geometry": torch.cat([own, mirror], dim=1)})["geometry"]
    torch.testing.assert_close(got, expected, rtol=1e-4, atol=1e-5)
    for whitening, few in ((both, own), (plain, own[:, :7])):
        with pytest.raises(ValueError, match=r"features of geometry are made of .* give what model"):
            whitening({"geometry": few})


@pytest.mark.parametrize("mirrored", [["geometry"], ["geometry", "light"], []])
def test_of_several_maps_each_is_read_again_as_it_was_written(codes, tmp_path, mirrored):
    maps = {name: fitted(codes, 3, 0.1) for name in ("geometry", "light")}
    written = Whitening(maps, mirrored=mirrored)
    written.save(tmp_path / "whitening.safetensors")
    again = Whitening.load(tmp_path / "whitening.safetensors")
    assert again.mirrored == written.mirrored == set(mirrored)
    both = torch.cat([codes[0], codes[1]], dim=1)
    given = {name: both if name in mirrored else codes[0] for name in maps} | {"camera": codes[0]}
    result = written(given)
    assert result.keys() == maps.keys()
    assert all(torch.equal(again(given)[name], result[name]) for name in result)
    assert written.state_dict() == {}  # a model's weights are the same with it and without


def test_maps_that_do_not_fit_are_refused(tmp_path):
    wrong = {"geometry_mean": torch.zeros(4), "geometry_map": torch.eye(3), "geometry_ratios": torch.ones(4)}
    save_file(wrong, tmp_path / "w")
    with pytest.raises(ValueError, match=r"geometry: a map of \(3, 3\) beside a mean of 4"):
        Whitening.load(tmp_path / "w")
