"""Which part of each image is read: decoding cuts it out first, and a list of one's own can name it."""

import io

import numpy as np
import pytest
from PIL import Image
from tests.data.conftest import noise

from derender.data import Unreadable, list_images, read_images
from derender.data.image import decode


def box(*sides: float) -> np.ndarray:
    return np.array(sides, np.float32)


@pytest.mark.parametrize("fit", ["crop", "pad", "stretch"])
@pytest.mark.parametrize("sides", [(3, 5, 23, 25), (0, 0, 40, 30), (2.4, 4.6, 22.4, 24.6), (1, 2, 31, 12)])
def test_a_box_is_the_same_as_cutting_first(encoded, fit, sides):
    whole = noise(1, width=40, height=30)
    left, top, right, bottom = np.round(sides).astype(int)
    expected = decode(encoded(np.ascontiguousarray(whole[top:bottom, left:right])), 12, fit)
    assert (decode(encoded(whole), 12, fit, box(*sides)) == expected).all()


@pytest.mark.parametrize(
    ("sides", "inside"),
    [
        ((-5, -7, 15, 13), (0, 0, 20, 20)),
        ((30, 20, 50, 40), (20, 10, 40, 30)),
        ((-20, -30, 60, 50), (5, 0, 35, 30)),
        ((-10, 5, 70, 15), (0, 5, 40, 15)),
    ],
)
def test_a_box_that_sticks_out_is_moved_and_shrunk_into_the_picture(encoded, sides, inside):
    whole = encoded(noise(2, width=40, height=30))
    assert (decode(whole, 10, "crop", box(*sides)) == decode(whole, 10, "crop", box(*inside))).all()


@pytest.mark.parametrize("sides", [(np.nan,) * 4, (5, 5, 5, 9), (9, 9, 3, 3), (0, 0, np.inf, 9)])
def test_a_box_that_is_none_makes_the_picture_unreadable(encoded, sides):
    with pytest.raises(Unreadable, match="no usable box is known"):
        decode(encoded(3), 8, "crop", box(*sides))


def test_a_box_in_a_turned_picture_is_in_upright_pixels():
    upright = Image.fromarray(noise(4, width=40, height=30))
    exif = Image.Exif()
    exif[0x0112] = 6  # stored lying, to be turned by 90 degrees
    turned, plain = io.BytesIO(), io.BytesIO()
    upright.transpose(Image.Transpose.ROTATE_90).save(turned, "PNG", exif=exif)
    upright.save(plain, "PNG")
    sides = box(10, 2, 30, 22)
    assert (decode(turned.getvalue(), 9, "crop", sides) == decode(plain.getvalue(), 9, "crop", sides)).all()


def test_a_box_holds_where_the_jpeg_is_decoded_at_a_reduced_scale(encoded):
    """A ramp says where the pixels came from: the mean of each column is its place in the image."""
    ramp = np.broadcast_to(np.linspace(0, 255, 1024)[None, :, None], (512, 1024, 3)).astype(np.uint8)
    jpeg = encoded(ramp, "JPEG", quality=95)
    part = decode(jpeg, 16, "crop", box(256, 100, 640, 484)).mean(axis=(0, 1))
    centres = 256 + (np.arange(16) + 0.5) * 384 / 16
    assert np.abs(part - centres / 1024 * 255).max() < 1.5
    small = decode(jpeg, 16, "crop", box(512, 100, 528, 116)).mean()
    assert abs(small - 520 / 1024 * 255) < 1.5


ROWS = ((2, 3, 22, 33), (5, 1, 25, 21), (0, 0, 40, 30))  # left, top, right, bottom
NAMES = ("000001.jpg", "000002.jpg", "000003.jpg")
SIZED = [f"{name},{a},{b},{c - a},{d - b}" for name, (a, b, c, d) in zip(NAMES, ROWS, strict=True)]
SIDES = [f"{name},{a},{b},{c},{d}" for name, (a, b, c, d) in zip(NAMES, ROWS, strict=True)]
HEADER = "file,left,top,width,height"


@pytest.fixture
def wild(tree, encoded):
    """``wild({file: text})`` is CelebA in the wild, three images of 40 x 34 pixels, with these lists."""

    def make(lists: dict[str, str], zipped: bool = False):
        pictures = {f"Img/img_celeba/{name}": encoded(noise(i, 40, 34)) for i, name in enumerate(NAMES)}
        attributes = "3\nBald \n" + "".join(f"{name} -1\n" for name in NAMES)
        owners = "3\nimage_id x_1 y_1 width height\n" + "".join(f"{name} 9 9 9 9\n" for name in NAMES)
        return tree(
            {**pictures, "list_attr_celeba.txt": attributes, "list_bbox_celeba.txt": owners, **lists}, zipped
        )

    return make


def boxes_of(source) -> list[list[float]]:
    inventory = list_images(source)
    inventory.files.close()
    assert inventory.layout == "celeba" and inventory.table.boxes is not None
    return inventory.table.boxes.tolist()


@pytest.mark.parametrize(
    ("file", "text"),
    [
        ("boxes.csv", "\n".join([HEADER, *SIZED])),
        ("boxes.csv", "\n".join(["file,left,top,right,bottom", *SIDES])),
        ("Anno/boxes.txt", "\r\n".join(line.replace(",", "  ") for line in ["3", *reversed(SIZED), ""])),
        ("celeba_crop_bbox.txt", "\n".join(f"img_celeba/{line}" for line in SIZED)),
        ("celeba_crop_bbox.txt", "\n".join(["3", "image_id x_1 y_1 width height", *SIZED]).replace(",", " ")),
    ],
)
def test_a_list_beside_celeba_in_the_wild_comes_before_the_rule(wild, file, text):
    for zipped in (False, True):
        assert boxes_of(wild({file: text}, zipped)) == [list(row) for row in ROWS]


def test_pictures_are_cut_by_the_list(wild, encoded):
    read = read_images(wild({"boxes.csv": "\n".join([HEADER, *SIZED])}), 10)
    for i, sides in enumerate(ROWS):
        assert (read.images[i] == decode(encoded(noise(i, 40, 34)), 10, "crop", box(*sides))).all()


@pytest.mark.parametrize(
    ("lines", "message"),
    [
        ([HEADER, *SIZED[:2]], r"boxes\.csv in .* has no row for 000003\.jpg \(1 of 3 images have none"),
        ([HEADER, *SIZED, SIZED[0]], r"line 5: a second row for 000001\.jpg"),
        (
            [HEADER, "000001.jpg,1,2,3"],
            r"line 2: expected an image's name and left, top, width, height, got '000001",
        ),
        ([*SIZED[:2], "000003.jpg,1,2,3,x"], r"line 3: expected an image's name and left, top, width"),
        ([*SIZED[:2], "000003.jpg,1,2,nan,4"], "line 3: expected an image's name"),
        ([HEADER, *SIZED[:2], "000003.jpg,1,2,0,4"], "line 4: the box has no area"),
        (["file,left,top,right,bottom", *SIDES[:2], "000003.jpg,9,2,5,4"], "line 4: the box has no area"),
        (
            ["file,x,y,w,h", *SIZED],
            "line 1: expected file,left,top,width,height or file,left,top,right,bottom",
        ),
        (
            [HEADER, *SIZED[:2], "000003.jpg,30,20,30,20"],
            r"line 4: the box from \(30, 20\) to \(60, 40\) lies outside 000003\.jpg, which is 40 x 34",
        ),
        ([HEADER], r"has no row for 000001\.jpg"),
    ],
)
def test_a_list_that_cannot_be_right_is_refused(wild, lines, message):
    with pytest.raises(ValueError, match=message):
        boxes_of(wild({"boxes.csv": "\n".join(lines)}))


def test_a_box_that_sticks_out_a_little_is_no_error(wild):
    rows = [*SIZED[:2], "000003.jpg,-5,-4,30,30"]
    assert boxes_of(wild({"boxes.csv": "\n".join([HEADER, *rows])}))[2] == [-5, -4, 25, 26]
