"""Images beside depth maps: how values become depth, which image goes with which map, what is refused."""

import io

import numpy as np
import pytest
from PIL import Image

from derender.data import read_ground_truth, read_images
from derender.data.maps import DEPTH_RANGE

SIZE = 12


@pytest.fixture
def pairs(tree, encoded):
    """``pairs(bits, names)`` writes three test images and two training images with their maps."""

    def make(bits: int = 8, names: tuple[str, str] = ("image", "depth"), extra: dict | None = None, **how):
        largest = 2**bits - 1
        kind = np.uint8 if bits == 8 else np.uint16
        files: dict = {}
        for subset, count in (("test", 3), ("train", 2)):
            for number in range(count):
                code = np.zeros((SIZE, SIZE), kind)
                code[2:10, 3:9] = np.linspace(1, largest, 6).astype(kind)
                code[4, 4] = largest * (number + 1) // 4
                files[f"synface/{subset}/image/{number:03d}_{names[0]}.png"] = encoded(
                    np.full((SIZE, SIZE, 3), 40 * number + 1 + count, np.uint8)
                )
                files[f"synface/{subset}/depth/{number:03d}_{names[1]}.png"] = encoded(code)
        return tree({**files, **(extra or {})}, **how)

    return make


@pytest.mark.parametrize("bits", [8, 16])
@pytest.mark.parametrize("zipped", [False, True])
def test_white_is_nearest_and_black_is_background(pairs, bits, zipped):
    truth = read_ground_truth(pairs(bits, zipped=zipped))
    near, far = DEPTH_RANGE
    assert len(truth) == 3 and truth.files[0] == "synface/test/image/000_image.png"
    assert truth.depth.shape == (3, SIZE, SIZE) and truth.mask.sum(axis=(1, 2)).tolist() == [48, 48, 48]
    assert (truth.depth[~truth.mask] == 0).all()
    np.testing.assert_allclose(truth.depth[:, 2, 8], near)
    np.testing.assert_allclose(truth.depth[:, 2, 3], far - (far - near) / (2**bits - 1), atol=1e-6)
    expected = [far - (far - near) * share / 4 for share in (1, 2, 3)]
    np.testing.assert_allclose(truth.depth[:, 4, 4], expected, atol=1e-3)
    assert truth.images[:, 0, 0, 0].tolist() == [4, 44, 84]
    assert truth.normal is truth.albedo is truth.light is truth.camera is None and truth.labels == {}


def test_subsets_limits_and_names_that_do_not_differ(pairs):
    path = pairs(names=("a", "a"))
    assert len(read_ground_truth(f"{path}::train")) == 2
    assert len(read_ground_truth(path, "test", limit=1)) == 1
    with pytest.raises(ValueError, match="no part 'val': its parts are test, train"):
        read_ground_truth(path, "val")


def test_maps_shrink_with_their_pictures_over_the_object_alone(tree, encoded):
    code = np.zeros((8, 8), np.uint8)
    code[:4, :3] = 255
    code[4:6] = [[51] * 8, [102] * 8]
    files = {"image/a.png": encoded(np.zeros((8, 8, 3), np.uint8)), "depth/a.png": encoded(code)}
    truth = read_ground_truth(tree(files), image_size=4)
    assert truth.images.shape == (1, 3, 4, 4)
    assert truth.mask[0, :, :3].tolist() == [[1, 0, 0], [1, 0, 0], [1, 1, 1], [0, 0, 0]]
    np.testing.assert_allclose(truth.depth[0, :2, 0], 0.9, rtol=1e-6)
    np.testing.assert_allclose(truth.depth[0, 2], 1.1 - 0.2 * 0.3, rtol=1e-6)


def test_pictures_are_read_without_their_maps(pairs):
    pictures = read_images(pairs(), SIZE, keep_duplicates=True)
    assert pictures.layout == "depth_pairs" and len(pictures) == 5
    assert all("/image/" in file for file in pictures.files)
    assert pictures.partition is not None and sorted(pictures.partition) == ["test"] * 3 + ["train"] * 2
    one = read_images(f"{pairs(name='b')}::train", SIZE, keep_duplicates=True)
    assert len(one) == 2


def test_a_folder_that_merely_is_called_image_is_no_such_set(tree):
    pictures = read_images(tree(["image/a.png", "image/b.png", "depth/a.png"]), 12)
    assert pictures.layout != "depth_pairs" and len(pictures) == 3


def coloured() -> bytes:
    buffer = io.BytesIO()
    Image.fromarray(np.arange(SIZE * SIZE * 3, dtype=np.uint8).reshape(SIZE, SIZE, 3)).save(buffer, "PNG")
    return buffer.getvalue()


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"nothing", r"depth/000_depth\.png in .* cannot be read"),
        (coloured(), r"000_depth\.png .* is RGB \(12, 12, 3\); a depth map is a grey PNG"),
    ],
)
def test_damaged_and_coloured_maps_are_named(pairs, content, message):
    path = pairs(extra={"synface/test/depth/000_depth.png": content})
    with pytest.raises(ValueError, match=message):
        read_ground_truth(path)


def test_a_map_of_another_size_is_named(pairs, encoded):
    small = encoded(np.full((6, 6), 9, np.uint8))
    path = pairs(extra={"synface/test/depth/000_depth.png": small})
    with pytest.raises(ValueError, match=r"is \(12, 12\), its map .*000_depth\.png \(6, 6\): both must"):
        read_ground_truth(path)
    assert read_ground_truth(path, image_size=6).depth.shape == (3, 6, 6)
