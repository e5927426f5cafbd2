"""The same result for an image whatever stands beside it: networks see images by fours, a thread each.

Rounding depends on the shape of a batch and on how threads share it, and many steps downhill magnify it. What
follows the networks gives the same bits for any multiple of four, and large portions take a third less time.
"""

import math
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

import torch
from jaxtyping import Float
from torch import Tensor

FEW = 4
"""Images in one call of a network."""
MOST = 64
T = TypeVar("T")


def by_portions(function: Callable[[Tensor], T], images: Float[Tensor, "n 3 h w"]) -> list[T]:
    """Results of portions of up to 64 images in order, the last one filled up to fours with its last image.

    The function is called by as many threads as torch has, each with one of torch's; on a GPU once, with all.
    """
    if images.is_cuda:
        return [function(images)]
    missing, threads = -len(images) % FEW, torch.get_num_threads()
    images = torch.cat([images, images[-1:].expand(missing, -1, -1, -1)])
    portions = images.contiguous().split(min(FEW * math.ceil(len(images) / FEW / threads), MOST))
    try:
        with ThreadPoolExecutor(threads, initializer=torch.set_num_threads, initargs=(1,)) as pool:
            return list(pool.map(function, portions))
    finally:
        torch.set_num_threads(threads)  # of threads that are yet to come
