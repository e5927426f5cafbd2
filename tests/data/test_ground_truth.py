"""Exact maps of rendered sets: units and signs as stored, gaps and misfits named."""

import math
from dataclasses import replace

import numpy as np
import pytest

from derender.data import read_ground_truth, read_images
from derender.data.synthetic import faces, write

HEADER = "file,identity,expression,ambient,diffuse,light_pitch,light_yaw,pitch,yaw,roll,tx,ty\n"
ROWS = [
    "images/000000.jpg,1,happy,0.3,0.6,30,-45,10,20,-5,0.001,-0.002\n",
    "images/000001.jpg,2,sad,.5,.4,0,0,0,0,0,0,0\n",
]


@pytest.fixture
def rendered(tree, encoded):
    """``rendered(**changed)``: two images of 6 x 4 with maps; names given None are left out."""

    def make(changed: dict[str, bytes | None] | None = None, zipped: bool = False):
        rng = np.random.default_rng(0)
        mask = np.zeros((4, 6), np.uint8)
        mask[1:3, 1:5] = 255
        files = {"test_gt/params.csv": (HEADER + "".join(ROWS)).encode()}
        for name in ("000000", "000001"):
            depth = np.where(mask > 0, rng.integers(16_000, 50_000, mask.shape), 0).astype(np.uint16)
            normal = rng.integers(0, 256, (4, 6, 3), dtype=np.uint8) * (mask[..., None] > 0).astype(np.uint8)
            normal[1, 1] = (128, 128, 255)
            files[f"test_gt/images/{name}.jpg"] = encoded(
                rng.integers(0, 256, (4, 6, 3), dtype=np.uint8), "JPEG"
            )
            files[f"test_gt/depth/{name}.png"] = encoded(depth)
            files[f"test_gt/normal/{name}.png"] = encoded(normal)
            files[f"test_gt/albedo/{name}.png"] = encoded(np.full((4, 6, 3), (255, 51, 0), np.uint8))
            files[f"test_gt/mask/{name}.png"] = encoded(mask)
        files = {
            file: content for file, content in {**files, **(changed or {})}.items() if content is not None
        }
        return tree(files, zipped), files

    return make


@pytest.mark.parametrize("zipped", [False, True])
def test_units_and_shapes(rendered, zipped):
    path, _ = rendered(zipped=zipped)
    truth = read_ground_truth(path)
    assert len(truth) == 2
    assert truth.files == ("test_gt/images/000000.jpg", "test_gt/images/000001.jpg")
    assert truth.images.shape == (2, 3, 4, 6)
    assert truth.mask.sum(axis=(1, 2)).tolist() == [8, 8]
    assert (truth.depth[~truth.mask] == 0).all()
    assert truth.depth[truth.mask].min() > 0.8 + 16_000 / 65_535 * 0.4 - 1e-6
    np.testing.assert_allclose(np.linalg.norm(truth.normal[truth.mask], axis=-1), 1, atol=1e-5)
    np.testing.assert_allclose(truth.normal[0, 1, 1], (0, 0, 1), atol=0.006)
    assert (truth.normal[~truth.mask] == 0).all()
    np.testing.assert_allclose(truth.albedo[0, :, 2, 2], (1, 0.2, 0))
    assert truth.light[0] == pytest.approx((0.3, 0.6, math.pi / 6, -math.pi / 4))
    assert truth.camera[0] == pytest.approx(
        (math.radians(10), math.radians(20), math.radians(-5), 0.001, -0.002, 0)
    )
    assert {name: column.tolist() for name, column in truth.labels.items()} == {
        "identity": ["1", "2"],
        "expression": ["happy", "sad"],
    }


def test_depth_code(rendered, encoded):
    depth = np.full((4, 6), 32_768, np.uint16)
    depth[0, 0], depth[0, 1] = 0, 65_535
    path, _ = rendered({"test_gt/depth/000000.png": encoded(depth)})
    truth = read_ground_truth(path, "test_gt")
    np.testing.assert_allclose(truth.depth[0, 0, :3], (0, 1.2, 1.0), atol=4e-6)


def test_only_pictures_with_depth_and_no_optional_maps(rendered):
    gone = {f"test_gt/{kind}/000001.png": None for kind in ("depth", "mask")}
    gone |= {f"test_gt/{kind}/00000{row}.png": None for kind in ("normal", "albedo") for row in (0, 1)}
    path, _ = rendered(gone)
    truth = read_ground_truth(f"{path}::test_gt")
    assert truth.files == ("test_gt/images/000000.jpg",)
    assert truth.normal is None and truth.albedo is None


@pytest.mark.parametrize(
    ("name", "array", "message"),
    [
        ("test_gt/mask/000001.png", None, r"has no test_gt/mask/000001\.png, which other images have"),
        (
            "test_gt/depth/000000.png",
            np.zeros((4, 6), np.uint8),
            r"depth/000000\.png .* is L \(4, 6\); expected I;16",
        ),
        (
            "test_gt/normal/000001.png",
            np.zeros((5, 6, 3), np.uint8),
            r"normal/000001\.png .* all of one size",
        ),
    ],
)
def test_misfits_are_named(rendered, encoded, name, array, message):
    path, _ = rendered({name: None if array is None else encoded(array)})
    with pytest.raises(ValueError, match=message):
        read_ground_truth(path)


def test_pictures_of_another_size_than_their_maps(rendered, encoded):
    images = {
        f"test_gt/images/00000{row}.jpg": encoded(np.zeros((8, 8, 3), np.uint8), "JPEG") for row in (0, 1)
    }
    path, _ = rendered(images)
    with pytest.raises(ValueError, match=r"images in .* are \(8, 8\), their maps \(4, 6\)"):
        read_ground_truth(path)


def test_damaged_map(rendered):
    path, _ = rendered({"test_gt/albedo/000000.png": b"text"})
    with pytest.raises(ValueError, match=r"albedo/000000\.png in .* cannot be read"):
        read_ground_truth(path)


def test_missing_column_and_missing_maps(rendered):
    text = (HEADER + "".join(ROWS)).replace("light_yaw", "light")
    path, _ = rendered({"test_gt/params.csv": text.encode()})
    with pytest.raises(ValueError, match="lacks the column for 'light_yaw_rad'"):
        read_ground_truth(path)
    path, _ = rendered({"test_gt/depth/000000.png": None, "test_gt/depth/000001.png": None}, zipped=True)
    with pytest.raises(ValueError, match=r"has no depth maps for its images \(expected test_gt/depth/000000"):
        read_ground_truth(path)


def test_limit(rendered):
    path, _ = rendered()
    assert len(read_ground_truth(path, limit=1)) == 1


def test_a_set_is_a_value(rendered):
    path, _ = rendered()
    truth = read_ground_truth(path)
    with pytest.raises(AttributeError):
        truth.depth = truth.depth
    assert len(replace(truth, labels={})) == 2


def test_what_our_generator_writes_is_read_back(tmp_path):
    made = faces.generate(3, 32, 0)
    write(made, tmp_path / "faces")
    truth = read_ground_truth(tmp_path / "faces")
    np.testing.assert_array_equal(truth.mask, made.mask)
    for read, written, error in [
        (truth.depth, made.depth, 0.4 / 65_535),
        (truth.normal, made.normal, 0.01),
        (truth.albedo * 255, made.albedo, 1e-4),
        (truth.light, made.light, 1e-6),
        (truth.camera, made.camera, 1e-6),
    ]:
        np.testing.assert_allclose(read, written, atol=error)
    pictures = read_images(tmp_path / "faces", 32)
    assert pictures.layout == "synface"
    np.testing.assert_array_equal(pictures.images, truth.images)
