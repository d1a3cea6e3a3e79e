"""The turn to an up axis: a world whose +y is up, which files and feet need."""

import numpy as np
from jaxtyping import Float

UP_AXES = {
    "+x": ((0, -1, 0), (1, 0, 0), (0, 0, 1)),
    "-x": ((0, 1, 0), (-1, 0, 0), (0, 0, 1)),
    "+y": ((1, 0, 0), (0, 1, 0), (0, 0, 1)),
    "-y": ((1, 0, 0), (0, -1, 0), (0, 0, -1)),
    "+z": ((1, 0, 0), (0, 0, 1), (0, -1, 0)),
    "-z": ((1, 0, 0), (0, 0, -1), (0, 1, 0)),
}


def up_rotation(up_axis: str) -> Float[np.ndarray, "3 3"]:
    """The rotation that takes a capture's own world to one whose +y is up; ``up_axis`` is "+z",
    "y", "-x", …
    """
    signed = up_axis if up_axis[:1] in "+-" else f"+{up_axis}"
    return np.array(UP_AXES[signed.lower()], dtype=np.float64)
