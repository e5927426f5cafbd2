"""Masks and exact maps: units and signs as stored, the published order of parts, and what does not fit."""

import io
import math

import numpy as np
import pytest
from PIL import Image
from tests.data.conftest import encode as png
from tests.data.conftest import noise

from derender.data import MASK_CLASSES, list_images, read_ground_truth, read_images, read_masks
from derender.data.maps import DEPTH_RANGE

HEADER = "file,identity,expression,ambient,diffuse,light_pitch,light_yaw,pitch,yaw,roll,tx,ty\n"
ROWS = "images/000000.jpg,1,happy,0.3,0.6,30,-45,10,20,-5,0.001,-0.002\n"
ROWS += "images/000001.jpg,2,sad,.5,.4,0,0,0,0,0,0,0\n"
MAPPING = "idx orig_idx         orig_file\n0       119613       119614.jpg\n"
MAPPING += "1       162769       162770.jpg\n2       182637       182638.jpg\n"
SIZE = 12
ZERO = np.zeros((32, 32), np.uint8)


def picture(seed: int, size: int = 32) -> bytes:
    return png(noise(seed, size, size))


def part(rows: slice, columns: slice, size: int = 16, mode: str = "L") -> bytes:
    """One part of a face as published: white on black, half the image's size."""
    mask = np.zeros((size, size), np.uint8)
    mask[rows, columns] = 255
    return png(Image.fromarray(mask).convert(mode))


@pytest.fixture
def rendered(tree, encoded):
    """``rendered(changed)``: two images of 6 x 4 with maps; names given None are left out."""

    def make(changed: dict[str, bytes | None] | None = None, zipped: bool = False):
        rng = np.random.default_rng(0)
        mask = np.zeros((4, 6), np.uint8)
        mask[1:3, 1:5] = 255
        files: dict[str, bytes | None] = {"params.csv": (HEADER + ROWS).encode()}
        for name in ("000000", "000001"):
            depth = np.where(mask > 0, rng.integers(16_000, 50_000, mask.shape), 0).astype(np.uint16)
            normal = rng.integers(0, 256, (4, 6, 3), dtype=np.uint8) * (mask[..., None] > 0).astype(np.uint8)
            normal[1, 1] = (128, 128, 255)
            files[f"images/{name}.jpg"] = encoded(rng.integers(0, 256, (4, 6, 3), dtype=np.uint8), "JPEG")
            albedo = np.full((4, 6, 3), (255, 51, 0), np.uint8)
            for kind, array in (("depth", depth), ("normal", normal), ("albedo", albedo), ("mask", mask)):
                files[f"{kind}/{name}.png"] = encoded(array)
        files |= changed or {}
        return tree({f"test_gt/{file}": one for file, one in files.items() if one is not None}, zipped)

    return make


@pytest.mark.parametrize("zipped", [False, True])
def test_units_and_shapes(rendered, zipped):
    truth = read_ground_truth(rendered(zipped=zipped))
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
    angles = tuple(map(math.radians, (10, 20, -5)))
    assert truth.camera[0] == pytest.approx((*angles, 0.001, -0.002, 0))
    labels = {name: column.tolist() for name, column in truth.labels.items()}
    assert labels == {"identity": ["1", "2"], "expression": ["happy", "sad"]}
    with pytest.raises(AttributeError):
        truth.depth = truth.depth


def test_depth_code_limits_and_optional_maps(rendered, encoded):
    depth = np.full((4, 6), 32_768, np.uint16)
    depth[0, 0], depth[0, 1] = 0, 65_535
    coded = read_ground_truth(rendered({"depth/000000.png": encoded(depth)}), "test_gt", limit=1)
    assert len(coded) == 1
    np.testing.assert_allclose(coded.depth[0, 0, :3], (0, 1.2, 1.0), atol=4e-6)
    gone = {f"{kind}/000001.png": None for kind in ("depth", "mask")}
    gone |= {f"{kind}/00000{row}.png": None for kind in ("normal", "albedo") for row in (0, 1)}
    truth = read_ground_truth(f"{rendered(gone, zipped=True)}::test_gt")
    assert truth.files == ("test_gt/images/000000.jpg",)
    assert truth.normal is None and truth.albedo is None


@pytest.fixture
def pairs(tree, encoded):
    """``pairs(bits, names)`` writes three test images and two training images with their depth maps."""

    def make(bits: int = 8, names: tuple[str, str] = ("image", "depth"), extra: dict | None = None, **how):
        largest = 2**bits - 1
        files: dict = {}
        for subset, count in (("test", 3), ("train", 2)):
            for number in range(count):
                code = np.zeros((SIZE, SIZE), np.uint8 if bits == 8 else np.uint16)
                code[2:10, 3:9] = np.linspace(1, largest, 6).astype(code.dtype)
                code[4, 4] = largest * (number + 1) // 4
                image = np.full((SIZE, SIZE, 3), 40 * number + 1 + count, np.uint8)
                files[f"synface/{subset}/image/{number:03d}_{names[0]}.png"] = encoded(image)
                files[f"synface/{subset}/depth/{number:03d}_{names[1]}.png"] = encoded(code)
        return tree({**files, **(extra or {})}, **how)

    return make


@pytest.mark.parametrize(("bits", "zipped"), [(8, False), (8, True), (16, False)])
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


def test_parts_of_pairs_and_images_without_their_maps(pairs, tree):
    path = pairs(names=("a", "a"))
    assert len(read_ground_truth(f"{path}::train")) == 2
    assert len(read_ground_truth(path, "test", limit=1)) == 1
    every = read_ground_truth(path, "test").files
    assert len(every) == 3 and read_ground_truth(path, "test", limit=2).files == every[::2]  # evenly spaced
    with pytest.raises(ValueError, match="no part 'val': its parts are test, train"):
        read_ground_truth(path, "val")
    images = read_images(path, SIZE, keep_duplicates=True)
    assert images.layout == "depth_pairs" and len(images) == 5
    assert all("/image/" in file for file in images.files)
    assert sorted(images.partition) == ["test"] * 3 + ["train"] * 2
    assert len(read_images(f"{path}::train", SIZE, keep_duplicates=True)) == 2
    other = read_images(tree(["image/a.png", "image/b.png", "depth/a.png"], name="other"), 12)
    assert other.layout != "depth_pairs" and len(other) == 3


def test_maps_shrink_with_their_images_over_the_object_alone(tree, encoded):
    code = np.zeros((8, 8), np.uint8)
    code[:4, :3] = 255
    code[4:6] = [[51] * 8, [102] * 8]
    files = {"image/a.png": encoded(np.zeros((8, 8, 3), np.uint8)), "depth/a.png": encoded(code)}
    truth = read_ground_truth(tree(files), image_size=4)
    assert truth.images.shape == (1, 3, 4, 4)
    assert truth.mask[0, :, :3].tolist() == [[1, 0, 0], [1, 0, 0], [1, 1, 1], [0, 0, 0]]
    np.testing.assert_allclose(truth.depth[0, :2, 0], 0.9, rtol=1e-6)
    np.testing.assert_allclose(truth.depth[0, 2], 1.1 - 0.2 * 0.3, rtol=1e-6)


@pytest.fixture
def published() -> dict[str, bytes | str]:
    """Face 0: skin everywhere but the first row, hair over its right half, glasses above hair's middle."""
    anno = "CelebAMask-HQ/CelebAMask-HQ-mask-anno/0/0000"
    return {
        "CelebAMask-HQ/CelebA-HQ-img/0.jpg": picture(0),
        "CelebAMask-HQ/CelebA-HQ-img/1.jpg": picture(1),
        f"{anno}0_skin.png": part(slice(1, 16), slice(0, 16)),
        f"{anno}0_hair.png": part(slice(0, 8), slice(8, 16), mode="RGB"),
        f"{anno}0_eye_g.png": part(slice(4, 6), slice(0, 16)),
        f"{anno}1_cloth.png": part(slice(12, 16), slice(0, 16)),
        "CelebAMask-HQ/README.txt": "non-commercial\n",
    }


@pytest.fixture
def merged() -> dict[str, bytes]:
    numbers = np.arange(32 * 32).reshape(32, 32) % 19
    files = {f"images/{row}.jpg": picture(row) for row in range(3)}
    return files | {f"masks/{row}.png": png(((numbers + row) % 19).astype(np.uint8)) for row in range(3)}


@pytest.mark.parametrize("zipped", [False, True])
def test_parts_are_merged_in_the_published_order(tree, published, zipped):
    images, masks, classes = read_masks(tree(published, zipped), 16)
    assert images.layout == "celebamask"
    assert classes == MASK_CLASSES and len(classes) == 19
    expected = np.ones((16, 16), np.uint8)
    expected[0] = 0
    expected[4:6] = classes.index("eye_g")
    expected[:8, 8:] = classes.index("hair")  # which hides skin and glasses
    assert (masks[0] == expected).all()
    assert np.unique(masks[1]).tolist() == [0, 18]
    assert (masks[1] == 18).sum() == 4 * 16


def test_merged_masks_and_palettes_are_resized_to_the_nearest_value(tree, merged):
    image = Image.frombytes("P", (32, 32), bytes([7] * 1024))
    image.putpalette([200, 10, 30] * 256)
    result = read_masks(tree({**merged, "images/3.jpg": picture(3), "masks/3.png": png(image)}), 16)
    assert (result.masks[3] == 7).all() and result.masks.dtype == np.uint8
    for row in range(3):
        whole = np.asarray(Image.open(io.BytesIO(merged[f"masks/{row}.png"])))
        inside = whole.reshape(16, 2, 16, 2).transpose(0, 2, 1, 3).reshape(16, 16, 4)
        assert (result.masks[row][..., None] == inside).any(axis=-1).all()


@pytest.mark.parametrize("fit", ["crop", "pad", "stretch"])
def test_a_mask_stays_on_its_image(tree, fit):
    """An image that is painted as its mask: after any fit, bright is where the class is."""
    mask = np.zeros((40, 64), np.uint8)
    mask[10:30, 20:50] = 13
    bright = np.repeat((mask[..., None] > 0).astype(np.uint8) * 255, 3, axis=-1)
    small = png(np.ascontiguousarray(mask[::2, ::2]))
    images, masks, _ = read_masks(tree({"images/0.png": png(bright), "masks/0.png": small}), 64, fit=fit)
    shown = images.images[0].mean(axis=0) > 127
    if fit == "pad":  # white above and below the image is no hair
        shown[:12] = shown[52:] = False
    assert (shown == (masks[0] == 13)).mean() > 0.97
    assert (masks[0] == 13).sum() > 500


def test_rows_belong_together_when_some_are_left_out(tree, merged):
    """A copy, an unreadable image and a limit take their masks with them."""
    files = {**merged, "images/3.jpg": merged["images/0.jpg"], "masks/3.png": merged["masks/0.png"]}
    images, masks, _ = read_masks(tree({**files, "images/1.jpg": b"no image"}), 32)
    assert images.files == ("images/0.jpg", "images/2.jpg")
    assert (masks[1] == np.asarray(Image.open(io.BytesIO(merged["masks/2.png"])))).all()
    assert len(images.duplicates) == len(images.skipped) == 1
    seen = []
    how = {"limit": 2, "keep_duplicates": True, "progress": lambda *step: seen.append(step)}
    limited = read_masks(tree(files), 8, **how)
    assert (len(limited.images), limited.masks.shape) == (2, (2, 8, 8))
    assert seen == [(2, 2), (1, 2), (2, 2)]


def test_official_parts_and_attributes(tree, published):
    anno = "CelebAMask-HQ/CelebAMask-HQ-mask-anno/0/00002_skin.png"
    third = {"CelebAMask-HQ/CelebA-HQ-img/2.jpg": picture(2), anno: part(slice(0, 9), slice(0, 9))}
    attributes = "2\nBald Smiling \n0.jpg  -1  1\n1.jpg   1 -1\n"
    lists = {"CelebA-HQ-to-CelebA-mapping.txt": MAPPING, "CelebAMask-HQ-attribute-anno.txt": attributes}
    source = tree({**published, **third, **lists})
    result = read_masks(source, 8)
    assert result.images.partition.tolist() == ["train", "train", "test"]
    assert result.images.labels["Bald"].tolist() == [0, 1, -1]
    assert [file[-5:] for file in read_masks(source, 8, subset="test").images.files] == ["2.jpg"]
    assert len(read_masks(f"{source}::train", 8).masks) == 2
    with pytest.raises(ValueError, match="no part 'validation': its parts are test, train"):
        read_masks(source, 8, subset="validation")


DEPTH = "synface/test/depth/000_depth.png"
MISFITS = [
    ("rendered", "mask/000001.png", None, r"has no test_gt/mask/000001\.png, which other images have"),
    ("rendered", "depth/000000.png", png(ZERO[:4, :6]), r"000000\.png .* is L \(4, 6\); expected I;16"),
    ("rendered", "normal/000001.png", picture(0, 5), r"000001\.png .* all of one size"),
    ("rendered", "albedo/000000.png", b"text", r"albedo/000000\.png in .* cannot be read"),
    ("rendered", "params.csv", (HEADER + ROWS).replace("_yaw", "").encode(), "lacks .* 'light_yaw_rad'"),
    ("pairs", DEPTH, b"nothing", r"depth/000_depth\.png in .* cannot be read"),
    ("pairs", DEPTH, picture(0, SIZE), r"000_depth\.png .* is RGB \(12, 12, 3\); a depth map is a grey PNG"),
    ("pairs", DEPTH, png(ZERO[:6, :6] + 9), r"is \(12, 12\), its map .*000_depth\.png \(6, 6\): both must"),
    ("masked", "", png(ZERO + 19), r"masks/1\.png .* number 19; classes are 0 \(background\) to 18 \(clot"),
    ("masked", "", png(ZERO.astype(np.uint16) + 300), "holds the number 300; classes are 0"),
    ("masked", "", png(np.tile(ZERO, (1, 2))), r"is 64 x 32 and its image images/1\.jpg 32 x 32: .* aspect"),
    ("masked", "", picture(0), "has 3 channels; a mask has one, of class numbers"),
    ("masked", "", b"no image", r"masks/1\.png in .* cannot be read"),
    ("masked", "", png(noise(1, channels=1))[:90], r"masks/1\.png in .* cannot be read"),
]


@pytest.mark.parametrize(("kind", "name", "content", "message"), MISFITS)
def test_misfits_are_named(rendered, pairs, merged, tree, kind, name, content, message):
    read = {
        "rendered": lambda: read_ground_truth(rendered({name: content})),
        "pairs": lambda: read_ground_truth(pairs(extra={name: content})),
        "masked": lambda: read_masks(tree({**merged, "masks/1.png": content}), 8),
    }
    with pytest.raises(ValueError, match=message):
        read[kind]()


def test_depth_maps_of_another_size_fit_at_one_that_is_given(pairs):
    path = pairs(extra={DEPTH: png(ZERO[:6, :6] + 9)})
    assert read_ground_truth(path, image_size=6).depth.shape == (3, 6, 6)
    with pytest.raises(ValueError, match=r"\?column= is for shards"):
        read_ground_truth(f"{path}?column=depth", image_size=6)


def test_missing_masks_images_and_lines_are_named(tree, published, merged):
    source = tree({**merged, "images/9.jpg": picture(9)})
    with list_images(source, dataset="celebamask") as listed:
        assert listed.table.labels["mask"].tolist() == [*(f"masks/{row}.png" for row in range(3)), ""]
    with pytest.raises(ValueError, match=r"1 of 4 images have no mask in .*, the first is 'images/9\.jpg'"):
        read_masks(source, 8, dataset="celebamask")
    nose = "CelebAMask-HQ/CelebAMask-HQ-mask-anno/0/00000_nose.png"
    two_sizes = {**published, nose: part(slice(0), slice(0), 12)}
    with pytest.raises(ValueError, match=r"is (12 x 12|16 x 16), other parts of the face are not"):
        read_masks(tree(two_sizes, name="two sizes"), 8)
    with pytest.raises(ValueError, match=r"holds no masks \(it was read as folder\): expected images/NAME"):
        read_masks(tree(["1.png"], name="no masks"), 8)
    for name, word, message in (
        ("faces", "img", "with CelebAMask-HQ-mask-anno/.*http"),
        ("parts", "anno", r"CelebAMask-HQ: .* expected CelebA-HQ-img/0\.jpg"),
    ):
        half = {file: content for file, content in published.items() if word in file}
        with pytest.raises(ValueError, match=message):
            list_images(tree(half, name=name), dataset="celebamask")
    for text, line in (("0 1 2.jpg\n", 1), (MAPPING + "3 x\n", 5), (MAPPING.replace("119614", "x"), 2)):
        files = {**published, "CelebA-HQ-to-CelebA-mapping.txt": text}
        with pytest.raises(ValueError, match=rf"mapping\.txt in .*, line {line}: expected idx orig_idx"):
            list_images(tree(files, name="mapped"))


@pytest.fixture
def folders(tree):
    """Three images, and masks of their own numbers in another folder."""
    masks = {f"a/{row}.png": png(np.full((16, 16), row, np.uint8)) for row in range(3)}
    return tree([f"a/{row}.png" for row in range(3)], name="photos"), tree(masks, name="masks")


def test_masks_lie_beside_their_images(folders, tree, tmp_path):
    told = []
    images, masks, classes = read_masks(folders[0], 4, masks=folders[1], progress=lambda *at: told.append(at))
    assert images.files == ("a/0.png", "a/1.png", "a/2.png") and told[-1] == (3, 3)
    assert masks.shape == (3, 4, 4) and [set(mask.ravel()) for mask in masks] == [{0}, {1}, {2}]
    assert classes == ("class 0", "class 1", "class 2")
    flat = {f"{row}.png": png(np.full((8, 8), row, np.uint8)) for row in range(3)}
    named = read_masks(folders[0], 4, masks=tree({**flat, "classes.txt": "sky\nwall\nfloor\ndoor\n"}))
    assert named.classes == ("sky", "wall", "floor", "door") and (named.masks == masks).all()
    (tmp_path / "classes.txt").write_text("sea\nsand\nrock\n")  # as `derender synth` writes them
    assert read_masks(folders[0], 4, masks=folders[1]).classes == ("sea", "sand", "rock")
    (folders[1] / "classes.txt").write_text("sky\nwall\nfloor\n")
    assert read_masks(folders[0], 4, masks=folders[1]).classes == ("sky", "wall", "floor")


def test_masks_beside_that_do_not_fit_are_named(folders):
    photos, masks = folders
    (masks / "classes.txt").write_text("sky\nwall\n")
    with pytest.raises(ValueError, match=r"a/2\.png in .* holds the number 2; classes\.txt names 2 classes"):
        read_masks(photos, 4, masks=masks)
    (masks / "a" / "1.png").write_bytes(png(np.full((8, 8), 255, np.uint8)))
    with pytest.raises(ValueError, match=r"holds the number 255.*a class of their own"):
        read_masks(photos, 4, masks=masks)
    (masks / "a" / "1.png").unlink()
    with pytest.raises(ValueError, match=r"1 of 3 images have no mask in .* 'a/1\.png'"):
        read_masks(photos, 4, masks=masks)
