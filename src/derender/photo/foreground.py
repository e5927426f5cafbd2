"""Which pixels of a photograph show the object: those whose colours resemble its middle more than its sides.

A model's surface has no outline: it continues behind the surroundings of the object. What
resembles both, as hair against a dark wall, counts as the object.
"""

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import avg_pool2d, interpolate, max_pool2d, pad

SIZE = 96  # pixels of the image in which colours are compared
SIDE = 0.06  # of the width: columns at the left and right that may show the background
ABOVE_SHOULDERS = 0.7  # of the height: how far down these columns reach
MIDDLE = (0.4, 0.6)  # half axes of the ellipse that shows the object, of half the sides
CROWN = (0.35, 0.1)  # half the width and height of the strip at the top that shows it, too
NEIGHBOURS = 5  # of each colour, among the examples
NEARER = 3.0  # background is so many times nearer to the colours of the sides than to those of the middle
DISTINCT = 0.05  # and by so much, in colours of 0..1
EXAMPLES = 400  # of each


def foreground(photo: Float[Tensor, "3 s s"]) -> Float[Tensor, "1 1 s s"]:
    """The object's share of each pixel, 0..1, of a crop that the object fills; colours in 0..1."""
    small = interpolate(photo[None], (SIZE, SIZE), mode="bilinear", antialias=True)
    along = torch.linspace(-1, 1, SIZE).to(photo)
    down, across = torch.meshgrid(along, along, indexing="ij")
    middle = (across / MIDDLE[0]) ** 2 + (down / MIDDLE[1]) ** 2 < 1
    middle |= (across.abs() < CROWN[0]) & (down < 2 * CROWN[1] - 1)
    sides = (across.abs() > 1 - 2 * SIDE) & (down < 2 * ABOVE_SHOULDERS - 1)
    colours = small[0].flatten(1).T
    nearest = []
    for shown in (middle, sides):
        examples = colours[shown.flatten()]
        examples = examples[:: -(-len(examples) // EXAMPLES)]
        near = torch.cdist(colours, examples).topk(NEIGHBOURS, largest=False).values
        nearest.append(near.mean(dim=1).view(1, 1, SIZE, SIZE))
    likely = (nearest[0] > NEARER * nearest[1] + DISTINCT).to(photo)
    likely = (avg_pool2d(pad(likely, (2,) * 4, mode="replicate"), 5, stride=1) > 0.5).to(photo)
    reached = likely * sides
    for _ in range(2 * SIZE):  # only what hangs together with the sides
        grown = max_pool2d(reached, 3, stride=1, padding=1) * likely
        if torch.equal(grown, reached):
            break
        reached = grown
    reached = avg_pool2d(pad(reached, (1,) * 4, mode="replicate"), 3, stride=1)
    return 1 - interpolate(reached, photo.shape[-2:], mode="bilinear")
