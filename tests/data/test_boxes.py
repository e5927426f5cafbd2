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
    """``wild(lines)`` is CelebA in the wild, three images of 40 x 34 pixels, with this ``boxes.csv``."""

    def make(lines: list[str]):
        pictures = {f"Img/img_celeba/{name}": encoded(noise(i, 40, 34)) for i, name in enumerate(NAMES)}
        attributes = "3\nBald \n" + "".join(f"{name} -1\n" for name in NAMES)
        files = {"list_attr_celeba.txt": attributes, "boxes.csv": "\n".join(lines)}
        return tree({**pictures, **files}, False)

    return make


def boxes_of(source) -> list[list[float]]:
    with list_images(source) as listed:
        assert listed.layout == "celeba" and listed.table.boxes is not None
        return listed.table.boxes.tolist()


def test_images_in_the_wild_are_cut_by_the_list_which_may_stick_out_a_little(wild, encoded):
    source = wild([HEADER, *SIZED[:2], "000003.jpg,-5,-4,30,30"])
    assert boxes_of(source) == [*map(list, ROWS[:2]), [-5, -4, 25, 26]]
    assert boxes_of(wild(["file,left,top,right,bottom", *SIDES])) == list(map(list, ROWS))
    read = read_images(source, 10)
    for i, sides in enumerate(ROWS[:2]):
        expected = decode(encoded(noise(i, 40, 34)), 10, "crop", np.array(sides, np.float32))
        assert (read.images[i] == expected).all()


@pytest.mark.parametrize(
    ("lines", "message"),
    [
        ([HEADER, *SIZED[:2]], r"boxes\.csv in .* has no row for 000003\.jpg \(1 of 3 images have none"),
        ([HEADER, "000001.jpg,1,2,3"], "line 2: expected 5 values as in the header"),
        ([HEADER, *SIZED[:2], "000003.jpg,1,2,3,x"], "something that is no number .*'x'"),
        ([HEADER, *SIZED[:2], "000003.jpg,1,2,nan,4"], r"the box of 000003\.jpg has no area"),
        (["file,x,y,w,h", *SIZED], "has no column 'left'; its columns are file, x, y, w, h"),
    ],
)
def test_a_list_that_cannot_be_right_is_refused(wild, lines, message):
    with pytest.raises(ValueError, match=message):
        boxes_of(wild(lines))
