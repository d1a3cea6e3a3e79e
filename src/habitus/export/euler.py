"""Rotations as three angles without jumps, for formats that turn a joint about one axis after the
other.
"""

import warnings

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation


def continuous_angles(
    quaternions: Float[np.ndarray, "T J 4"],
    order: str,
    last: Float[np.ndarray, "J 3"] | None = None,
) -> Float[np.ndarray, "T J 3"]:
    """Angles (degrees) about three different axes, as near to those of the frame before as they can
    be.

    Of the two triples that make a rotation the nearer is taken, whole turns added: what lies
    between two frames is then as short a way as three angles know. ``order`` is SciPy's: "xyz"
    about the parent's axes, "ZXY" about the joint's. last: angles of the frame before the first.
    """
    shape = quaternions.shape[:-1]
    with warnings.catch_warnings():
        warnings.simplefilter(
            "ignore"
        )  # at the middle angle's end the other two are one: any split will do
        first = (
            Rotation.from_quat(quaternions.reshape(-1, 4))
            .as_euler(order, degrees=True)
            .reshape(*shape, 3)
        )
    other = first * [1.0, -1.0, 1.0] + 180.0
    both = np.stack([first, other], axis=1)
    out = np.empty_like(first)
    last = np.zeros(first.shape[1:]) if last is None else last
    for t, pair in enumerate(both):
        near = pair + 360.0 * np.round((last - pair) / 360.0)
        way = np.abs(near - last).sum(axis=-1)
        last = out[t] = np.where((way[0] <= way[1])[:, None], near[0], near[1])
    return out
