"""The outline of an object told by colour, and what depends on it when a photograph is turned."""

import math

import pytest
import torch

from derender.data.synthetic import faces
from derender.data.synthetic.settings import VIEWS, FaceSettings
from derender.photo import PhotoDetail
from derender.photo.foreground import foreground
from derender.scene import Scene

FOV, SIZE = 10.0, 128


def ball() -> tuple[torch.Tensor, torch.Tensor]:
    """A brown oval as high as the image on blue, (3, S, S), and where it is."""
    along = torch.linspace(-1, 1, SIZE)
    shown = (along / 0.7) ** 2 + (along[:, None] / 1.1) ** 2 < 1
    colour = torch.where(shown, torch.tensor([0.6, 0.4, 0.3])[:, None, None], 0.0)
    return torch.where(shown, colour, torch.tensor([0.1, 0.3, 0.6])[:, None, None]), shown


def test_an_oval_is_told_from_its_background():
    photo, shown = ball()
    found = foreground(photo)[0, 0] > 0.5
    assert (found == shown).float().mean() > 0.98


@pytest.mark.parametrize("background", ["the object's colour", "grain"])
def test_what_cannot_be_told_apart_is_the_object(background):
    photo = torch.full((3, SIZE, SIZE), 0.4)
    if background == "grain":
        photo = torch.rand(3, SIZE, SIZE, generator=torch.Generator().manual_seed(0))
    assert foreground(photo).mean() > 0.99


def test_generated_heads_are_told_from_their_backgrounds():
    made = faces.generate(6, SIZE, 5, FaceSettings(view=VIEWS["frontal"]))
    for image, mask in zip(made.images, made.mask, strict=True):
        found = foreground(torch.from_numpy(image).float() / 255)[0, 0] > 0.5
        mask = torch.from_numpy(mask > 0)
        assert (found & mask).sum() > 0.95 * mask.sum()  # the head is never cut


def test_a_background_stays_where_it_is_and_the_side_that_comes_round_is_the_objects():
    photo, shown = ball()
    depth = 1.0 - 0.04 * shown.float()
    flat = torch.nn.functional.interpolate(depth[None, None], (32, 32), mode="area")[0]
    scene = Scene(
        flat, torch.full((1, 3, 32, 32), 0.5), torch.tensor([[0.6, 0.4, 0.0, 0.0]]), torch.zeros(1, 6)
    )
    camera = torch.zeros(1, 6)
    camera[:, 1] = math.radians(20)
    seen = PhotoDetail(photo, scene, FOV)(scene.with_parameters(camera=camera)).image[0]
    blue = seen[2] > seen[0] + 0.1
    corners = [slice(None, 16), slice(-16, None)]
    for rows in corners:
        for columns in corners:
            torch.testing.assert_close(seen[:, rows, columns], photo[:, rows, columns], atol=0.05, rtol=0)
    middle = slice(SIZE // 2 - 4, SIZE // 2 + 4)
    width = (~blue[middle]).float().sum(dim=1).mean()
    assert width > shown[middle].float().sum(dim=1).mean()  # front and side together are wider
