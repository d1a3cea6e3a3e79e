"""How well each part of a fitted body is known, as a value."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

GUESSED = 0.06
"""Metres: a part whose skin is known no better (standard deviation) is guessed."""


class Guessed(NamedTuple):
    """How well each joint's segment is known: ``spread`` (F, J) in metres, in the spans of frames
    from ``edges`` (F,).

    It is the standard deviation of where the segment's skin is; zero for a joint that carries none.
    """

    edges: Int[np.ndarray, " F"]
    spread: Float[np.ndarray, "F J"]

    def joints(self) -> Bool[np.ndarray, " J"]:
        """Which joints' segments are guessed (GUESSED) in half of the spans, or more."""
        return np.median(self.spread, axis=0) > GUESSED
