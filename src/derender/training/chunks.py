"""Less memory for the same result: pictures go through a network in chunks, each computed again in backward.

Of a chunk only what goes in and comes out is kept; whatever couples the pictures of a batch (LOOCC's
negatives, masked means, shared shapes) sees all that came out. Loss and gradient are therefore those of the
whole batch, up to the rounding of sums, for one more forward pass. Source of the idea: gradient caching (Gao
et al. 2021), here through torch's activation checkpointing. Leaves out networks whose pictures see each other
(batch norm): there are none.
"""

from collections.abc import Callable, Mapping

import torch
from jaxtyping import Shaped
from torch import Tensor
from torch.utils.checkpoint import checkpoint

Columns = Mapping[str, Shaped[Tensor, "n ..."]]


def in_chunks(function: Callable[[Columns], Columns], inputs: Columns, chunks: int) -> dict[str, Tensor]:
    """Apply a function of rows to ``inputs`` in so many runs of rows, joined again.

    What the function gives for a row must not depend on the other rows.
    """
    if chunks == 1:
        return dict(function(inputs))
    pieces = zip(*(column.chunk(chunks) for column in inputs.values()), strict=True)
    rows = [dict(zip(inputs, piece, strict=True)) for piece in pieces]
    if torch.is_grad_enabled():
        done = [checkpoint(function, row, use_reentrant=False, preserve_rng_state=False) for row in rows]
    else:
        done = [function(row) for row in rows]
    return {name: torch.cat([columns[name] for columns in done]) for name in done[0]}
