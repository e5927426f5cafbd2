"""A list of one's own names the part of each image in the wild that is read."""

import numpy as np
import pytest
from tests.data.conftest import noise

from derender.data import list_images, read_images
from derender.data.image import decode

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
        files = {"list_attr_celeba.txt": attributes, "list_bbox_celeba.txt": owners}
        return tree({**pictures, **files, **lists}, zipped)

    return make


def boxes_of(source) -> list[list[float]]:
    with list_images(source) as listed:
        assert listed.layout == "celeba" and listed.table.boxes is not None
        return listed.table.boxes.tolist()


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


def test_images_are_cut_by_the_list_which_may_stick_out_a_little(wild, encoded):
    rows = [*SIZED[:2], "000003.jpg,-5,-4,30,30"]
    source = wild({"boxes.csv": "\n".join([HEADER, *rows])})
    assert boxes_of(source)[2] == [-5, -4, 25, 26]
    read = read_images(source, 10)
    for i, sides in enumerate(ROWS[:2]):
        expected = decode(encoded(noise(i, 40, 34)), 10, "crop", np.array(sides, np.float32))
        assert (read.images[i] == expected).all()


FIRST, NONE = [HEADER, *SIZED[:2]], r"line {}: expected an image's name and left, top, width, height, got '00"
REFUSED = [
    (FIRST, r"boxes\.csv in .* has no row for 000003\.jpg \(1 of 3 images have none"),
    ([HEADER], r"has no row for 000001\.jpg"),
    ([*FIRST, SIZED[2], SIZED[0]], r"line 5: a second row for 000001\.jpg"),
    ([HEADER, "000001.jpg,1,2,3"], NONE.format(2)),
    ([*SIZED[:2], "000003.jpg,1,2,3,x"], NONE.format(3)),
    ([*SIZED[:2], "000003.jpg,1,2,nan,4"], NONE.format(3)),
    ([*FIRST, "000003.jpg,1,2,0,4"], "line 4: the box has no area"),
    (["file,left,top,right,bottom", *SIDES[:2], "000003.jpg,9,2,5,4"], "line 4: the box has no area"),
    (["file,x,y,w,h", *SIZED], "line 1: expected file,left,top,width,height or file,left,top,right,bottom"),
    ([*FIRST, "000003.jpg,30,20,30,20"], r"line 4: the box from \(30, 20\) to \(60, 40\) lies outside 00000"),
]


@pytest.mark.parametrize(("lines", "message"), REFUSED)
def test_a_list_that_cannot_be_right_is_refused(wild, lines, message):
    with pytest.raises(ValueError, match=message):
        boxes_of(wild({"boxes.csv": "\n".join(lines)}))
