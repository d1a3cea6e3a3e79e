"""What formats of animation share: even times of frames, and rotations of linear parts."""

import numpy as np
from jaxtyping import Float

from habitus.errors import HabitusError

MAX_RATE = 1000.0
MOST_FRAMES = 200_000


def even_times(
    keys: list[np.ndarray], frame_rate: float = 0.0
) -> tuple[Float[np.ndarray, " T"], float]:
    """Times of frames (s), and frames a second, by the channel with most keys (times in s).

    Where its keys are farther apart than a frame of ``frame_rate`` (0: unknown), that decides.
    Raises HabitusError for more frames than any motion has.
    """
    most = max(keys, key=len)
    first, last = min(k[0] for k in keys), max(k[-1] for k in keys)
    step = float(np.median(np.diff(most))) if len(most) > 1 else 1.0 / 30.0
    rate = 1.0 / step
    if rate < 0.95 * frame_rate:
        rate = frame_rate
    if abs(round(rate) - rate) < 1e-3 * rate:
        rate = float(round(rate))
    count = round((last - first) * rate) + 1
    if not rate <= MAX_RATE or count > MOST_FRAMES:
        raise HabitusError(f"{count} frames at {rate:.3g} Hz; expected up to {MOST_FRAMES}")
    even = first + np.arange(count) / rate
    if len(most) == count and np.abs(even - most).max() < 1e-3 / rate:
        even = most
    return even, rate


def turns_of(linear: Float[np.ndarray, "*batch 3 3"]) -> Float[np.ndarray, "*batch 3 3"]:
    """The rotations nearest to linear parts of transformations."""
    u, s, vt = np.linalg.svd(linear)
    if (s[..., -1] < 1e-12).any():
        raise HabitusError("a node of no size; export it again")
    sign = np.sign(np.linalg.det(u @ vt))
    u[..., -1] *= sign[..., None]
    return u @ vt
