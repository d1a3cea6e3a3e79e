"""Sampling that animation formats share: evenly spaced frames, rotations of linear parts."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from jaxtyping import Float

from habitus.errors import HabitusError
from habitus.io.archives import reason

MAX_RATE = 1000.0
MOST_FRAMES = 200_000


@contextmanager
def reading_animation(path: Path) -> Iterator[None]:
    """Raise HabitusError, with the file named, for whatever a damaged animation makes the block
    raise.
    """
    try:
        yield
    except HabitusError as error:
        raise HabitusError(f"{path}: {str(error).removeprefix(f'{path}: ')}") from error
    except (TypeError, ValueError, KeyError, AttributeError, IndexError) as error:
        raise HabitusError(
            f"{path}: its animation is damaged ({reason(error)}); export it again"
        ) from error


def even_times(
    keys: list[np.ndarray], frame_rate: float = 0.0
) -> tuple[Float[np.ndarray, " T"], float]:
    """Evenly spaced times (s) and their rate (Hz).

    keys: times (s) of each channel's keys. The rate is that of the channel with most keys, or
    ``frame_rate`` (0: unknown) where its keys are sparser. Raises HabitusError for more than
    ``MOST_FRAMES`` frames or ``MAX_RATE``.
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
    """The nearest rotations to linear parts of transformations. Raises HabitusError for singular
    ones.
    """
    u, s, vt = np.linalg.svd(linear)
    if (s[..., -1] < 1e-12).any():
        raise HabitusError("a node of no size; export it again")
    sign = np.sign(np.linalg.det(u @ vt))
    u[..., -1] *= sign[..., None]
    return u @ vt
