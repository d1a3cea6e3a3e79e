"""Samples put into a C3D file that is there: its own bytes, but for those of the samples.

So analog channels, events, parameters and every other point stay to the last bit, whoever wrote the
file.
"""

import numpy as np
from jaxtyping import Bool, Float, Int

from habitus.errors import HabitusError
from habitus.io.captures.c3d import DataPlace, find_points

_LARGEST = 32767


def filled_c3d(
    content: bytes,
    name: str,
    columns: Int[np.ndarray, " M"],
    points: Float[np.ndarray, "T M 3"],
    filled: Bool[np.ndarray, "T M"],
) -> bytes:
    """The bytes of a C3D file with ``points``, in its unit and axes, where ``filled``, in its M
    ``columns``.

    The fourth word of such a sample is 0: the format's mark for what no camera measured (residual
    0, no cameras). ``name`` is what errors call the file. Raises HabitusError where the file is no
    C3D file, has other frames, or its whole numbers do not reach as far.
    """
    place, processor = find_points(content, name)
    if len(points) != place.frames:
        raise HabitusError(
            f"{name}: {place.frames} frames, {len(points)} to be filled; give the fitted capture"
        )
    out = np.frombuffer(content, np.uint8).copy()
    rows, which = np.nonzero(filled)
    at = place.start + rows * place.stride + 4 * place.word * columns[which]
    words = _words(points[rows, which], place, processor, name)
    out[at[:, None] + np.arange(4 * place.word)] = words
    return out.tobytes()


def _words(
    points: Float[np.ndarray, "S 3"], place: DataPlace, processor: str, name: str
) -> np.ndarray:
    """The bytes (S, 16 or 8) of samples: x, y, z and a 0."""
    samples = np.concatenate([points, np.zeros((len(points), 1))], axis=1)
    if place.word == 2:
        whole = np.round(samples / place.scale)
        if np.abs(whole).max(initial=0) > _LARGEST:
            raise HabitusError(
                f"{name}: its whole numbers of {place.scale:g} do not reach the samples; use real "
                "numbers"
            )
        return np.ascontiguousarray(whole.astype(">i2" if processor == "mips" else "<i2")).view(
            np.uint8
        )
    if processor == "dec":
        bits = (samples * 4.0).astype("<f4").view("<u4")
        return np.ascontiguousarray((bits >> 16) | (bits << 16)).astype("<u4").view(np.uint8)
    return np.ascontiguousarray(samples.astype(">f4" if processor == "mips" else "<f4")).view(
        np.uint8
    )
