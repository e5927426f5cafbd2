"""Retrieve in Style: clusters, scores and the matrix on planted structure, then a generator that has it."""

import numpy as np
import pytest
import torch
from PIL import Image

from derender.baselines import load_baseline, ris
from derender.baselines.e4e import E4e, E4eSettings
from derender.baselines.generator import Generator, GeneratorSettings, style_layers
from derender.data import MASK_CLASSES, read_images

PARTS = ("hair", "skin", "nose", "mouth")  # of the planted generator: quarters of the width, left to right
EACH = 4  # channels that paint a part
WIDTHS = {"channel_base": 512, "channel_max": EACH * len(PARTS)}
SIZES = GeneratorSettings(image_size=32, style_size=8, mapping_layers=2, **WIDTHS)


def channels_of(part: int) -> slice:
    return slice(EACH * part, EACH * (part + 1))


def plant(net: Generator) -> None:
    """Every channel lives in one quarter of the constant, and no convolution mixes those of two quarters."""
    with torch.no_grad():
        random = torch.Generator().manual_seed(3)
        net.constant.zero_()
        for part in range(len(PARTS)):
            net.constant[:, channels_of(part), :, part] = 1 + torch.rand(1, EACH, 4, generator=random)
        for conv in net.convs:
            conv.weight.zero_()
            for own in map(channels_of, range(len(PARTS))):
                conv.weight[own, own, 1, 1] = torch.rand(EACH, EACH, generator=random)
        for rgb in net.to_rgbs:
            rgb.weight.copy_(torch.rand(rgb.weight.shape, generator=random))


@pytest.fixture(scope="module")
def planted() -> E4e:
    """An untrained encoder, with the planted generator."""
    torch.manual_seed(0)
    model = E4e(E4eSettings(image_size=32, width=4, units=(1, 1, 1, 1), generator=SIZES))
    plant(model.generator)
    model.centre.copy_(torch.randn(model.centre.shape))
    return model.eval().requires_grad_(False)


@pytest.fixture(scope="module")
def catalogue(planted):
    """Four clusters, named by masks of the four quarters."""
    images = torch.rand(8, 3, 32, 32, generator=torch.Generator().manual_seed(1))
    parts = torch.eye(4).repeat_interleave(8, dim=1)[None, :, None].expand(8, -1, 32, -1)
    config = ris.RisConfig(image_size=32, clusters=4, samples=20)
    return ris.build_catalogue(planted, images, parts, PARTS, config)


def test_spherical_kmeans_finds_directions_whatever_their_length(generator):
    directions = torch.eye(5)[:3] + 0.01
    truth = torch.randint(3, (300,), generator=generator)
    lengths = 10 ** (4 * torch.rand(300, 1, generator=generator))
    rows = (directions[truth] + 0.05 * torch.rand(300, 5, generator=generator)) * lengths
    centres = ris.spherical_kmeans(rows, 3, generator)
    torch.testing.assert_close(centres.norm(dim=1), torch.ones(3))
    result = (rows @ centres.T).argmax(dim=1)
    assert len(set(zip(truth.tolist(), result.tolist(), strict=True))) == 3
    with pytest.raises(ValueError, match="4 clusters need at least as many places, got 3"):
        ris.spherical_kmeans(rows[:3], 4, generator)


def test_small_parts_get_the_cluster_where_they_gather():
    """A fifth of cluster 1 is eye, which is rare; a hundredth of cluster 0 is, by chance."""
    clusters = torch.zeros(1, 10, 100, dtype=torch.int64)
    clusters[0, 9] = 1
    eye = torch.zeros(10, 100)
    eye[9, :60] = 1
    eye[0, :5] = 1
    result = ris.name_clusters(clusters, 3, torch.stack([1 - eye, eye])[None])
    assert result.tolist() == [0, 1, 0]  # cluster 2 was never seen: the largest part


def test_scores_are_mean_energy_over_a_part(generator):
    activation = torch.randn(3, 4, 8, 8, generator=generator) * 5 + 2
    activation[:, 0, :, 4:] *= 10
    left = torch.zeros(3, 1, 8, 8)
    left[..., :4] = 1
    energy, area = ris.part_energy(activation, torch.cat([left, 1 - left], dim=1))
    scores = energy / area
    assert area.tolist() == [[96], [96]]
    torch.testing.assert_close(scores.mean(dim=0), torch.ones(4), rtol=1e-4, atol=1e-4)
    assert scores[1, 0] > 1.8 and (scores[:, 1:] - 1).abs().max() < 0.3
    assert torch.allclose(ris.part_energy(activation * 7 + 1, left)[0], energy[:1], rtol=1e-3)


def test_the_rules_of_the_matrix_for_the_published_network(generator):
    """8 parts and the pose over 9,088 channels: colours, the first 2,048, threshold."""
    widths = {"channel_base": 32_768, "channel_max": 512}
    layers = style_layers(GeneratorSettings(image_size=1024, style_size=512, **widths))
    parts = ("background", "skin", "hair", "eyes", "nose", "mouth", "neck", "ears")
    scores = torch.rand(8, 9_088, generator=generator)
    scores[2, :100] = 5
    matrix = ris.part_matrix(scores, layers, parts)
    assert matrix.shape == (9, 9_088)
    colour = torch.cat([torch.full((layer.channels,), layer.colour) for layer in layers])
    assert colour.sum() == 3_040
    assert (matrix[:, colour] == 0).all()
    kept = (scores / 0.1).softmax(dim=0)
    free = ~colour & (torch.arange(9_088) >= 2_048)
    torch.testing.assert_close(matrix[:8, free], torch.where(kept >= 0.8, kept, 0.0)[:, free])
    assert (matrix[[0, 1, 3, 4, 5, 6, 7], :2_048] == 0).all()
    assert (matrix[2, :100] > 0.99).all()
    torch.testing.assert_close((matrix[8] + matrix[2])[:2_048][~colour[:2_048]], torch.ones(2_048 - 512))
    assert (matrix[8, 2_048:] == 0).all()


def test_classes_become_parts(tmp_path):
    """Of CelebAMask-HQ's classes, in images of which the training part is used."""
    for folder in ("images", "masks"):
        (tmp_path / folder).mkdir()
    mask = np.zeros((32, 32), np.uint8)
    mask[:8], mask[8:16], mask[16:24] = 4, 5, 2
    for number in range(10):
        Image.new("RGB", (32, 32), (25 * number, 0, 0)).save(tmp_path / "images" / f"{number}.png")
        Image.fromarray(mask).save(tmp_path / "masks" / f"{number}.png")
    (tmp_path / "masks" / "classes.txt").write_text("\n".join(MASK_CLASSES))
    images = read_images(tmp_path / "images", 32)
    inputs, parts, names = ris.masked_rows(images, ris.RisConfig(image_size=32, masks=f"{tmp_path}/masks"))
    assert len(inputs) == len(parts) == 8 and names == ("background", "nose", "eyes")
    assert parts[0, :, ::8, 0].tolist() == [[0, 0, 0, 1], [0, 0, 1, 0], [1, 1, 0, 0]]


def test_a_planted_catalogue_is_found(catalogue, planted):
    """Each quarter's channels get its part, but for the coarse ones, which are hair's and the pose's."""
    model = catalogue
    assert sorted(model.cluster_part.tolist()) == [0, 1, 2, 3]
    start = 0
    for number, layer in enumerate(planted.generator.layers):
        *rows, pose = model.matrix[:, start : start + layer.channels]
        for part, row in enumerate(rows):
            own = row[channels_of(part)]
            others = torch.cat([row[: EACH * part], row[EACH * (part + 1) :]])
            expected = not layer.colour and (number >= 4 or part == 0)
            assert (own > 0.8).all() if expected else (own == 0).all()
            assert (others == 0).all()
        coarse = number < 4 and not layer.colour
        torch.testing.assert_close(pose, 1 - rows[0] if coarse else torch.zeros_like(pose))
        start += layer.channels


def test_taking_a_part_changes_its_place_alone(catalogue, generator):
    model = catalogue
    images, others = (torch.rand(3, 3, 32, 32, generator=generator) for _ in range(2))
    others = others.flip(1) ** 3
    own, swapped = model.rebuild(model.styles(images)), model.swapped(images, others, "mouth")
    change = (swapped - own).abs().mean(dim=(0, 1, 2))
    assert change[24:].min() > 0.05 and change[:16].max() == 0  # the filter reaches 7 pixels beyond


def test_a_catalogue_lies_in_a_folder(catalogue, tmp_path):
    catalogue.save(tmp_path / "ris")
    again = load_baseline(tmp_path / "ris", "ris")
    images = torch.rand(2, 3, 32, 32)
    result = again.embed(images)
    assert list(result) == [*PARTS, "pose"]
    assert {tuple(values.shape) for values in result.values()} == {(2, again.matrix.shape[1])}
    for name, values in catalogue.embed(images).items():
        assert np.array_equal(values.numpy(), result[name].numpy())
    again.choose(("pose",))
    assert list(again.embed(images)) == ["pose"]
    with pytest.raises(ValueError, match=r"unknown feature of ris 'hiar'.*'hair'"):
        again.choose(("hiar",))
