"""Leading batch axes."""

from collections.abc import Sequence

import numpy as np
import torch


def broadcast_shapes(*shapes: Sequence[int]) -> torch.Size:
    """The shape that all broadcast to; ValueError where they do not.

    torch's own function of this name loads a system of computer algebra when first called, which takes half a second.
    """
    return torch.Size(np.broadcast_shapes(*(tuple(shape) for shape in shapes)))
