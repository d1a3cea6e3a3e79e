"""Which moments of two motions are compared, and what the two bodies have in common."""

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import product

import numpy as np
from jaxtyping import Float

from habitus.body.model import BodyModel
from habitus.body.motion import Moving
from habitus.errors import HabitusError

_BATCH = 32
_WHOLE = 1e-3  # of a frame: a moment that is nearer to a frame is that frame


@dataclass(frozen=True, eq=False)
class Pairing:
    """T moments: ``times`` (s, A's clock) and the places, in frames, of these moments in A and in
    B.

    ``rate_hz`` is how many moments a second are compared; ``notes`` say what was left out or lies
    between frames.
    """

    times: Float[np.ndarray, " T"]
    frames: tuple[Float[np.ndarray, " T"], Float[np.ndarray, " T"]]
    rate_hz: float
    notes: tuple[str, ...]

    @property
    def nearest(self) -> tuple[np.ndarray, np.ndarray]:
        """The nearest whole frames of both."""
        return tuple(np.round(frames).astype(np.int64) for frames in self.frames)  # type: ignore[return-value]


def pair(a: Moving, b: Moving, offset: float = 0.0) -> Pairing:
    """The moments that both have, at the frames of the slower one; B begins ``offset`` seconds
    after A.

    Raises HabitusError where they have none in common.
    """
    if not np.isfinite(offset):
        raise HabitusError(f"the offset is {offset}; expected seconds from A's first frame to B's")
    slow, fast, swapped = (a, b, False) if a.rate_hz <= b.rate_hz else (b, a, True)
    shift = -offset if swapped else offset  # of the faster one's first frame after the slower one's
    own = np.arange(slow.num_frames)
    other = _whole((own / slow.rate_hz - shift) * fast.rate_hz)
    both = (other >= 0) & (other <= fast.num_frames - 1)
    if not both.any():
        ends = " and ".join(f"{m.num_frames / m.rate_hz:.2f} s" for m in (a, b))
        raise HabitusError(
            f"A and B have no moment in common ({ends} long, B {offset:g} s after A); give "
            "another offset"
        )
    own = own[both].astype(float)
    other = other[both]
    frames = (other, own) if swapped else (own, other)
    notes = [*_rates(a, b, other), *_ranges(a, b, len(own), slow.rate_hz, offset)]
    return Pairing(frames[0] / a.rate_hz, frames, slow.rate_hz, tuple(notes))


def _whole(frames: np.ndarray) -> np.ndarray:
    near = np.round(frames)
    return np.where(np.abs(frames - near) < _WHOLE, near, frames)


def _rates(a: Moving, b: Moving, other: np.ndarray) -> Iterator[str]:
    if abs(a.rate_hz - b.rate_hz) > 1e-6 * a.rate_hz:
        between = " Between its frames the faster one is interpolated." if (other % 1).any() else ""
        rates = f"A has {a.rate_hz:g} frames a second, B {b.rate_hz:g}"
        yield f"{rates}: they are compared at the slower one's frames.{between}"
    elif (other % 1).any():
        yield (
            "The offset is no whole number of frames: the later one is interpolated between its "
            "frames."
        )


def _ranges(a: Moving, b: Moving, count: int, rate_hz: float, offset: float) -> Iterator[str]:
    seconds = [m.num_frames / m.rate_hz for m in (a, b)]
    if max(seconds) - count / rate_hz > 1.5 / rate_hz:
        lengths = f"A is {seconds[0]:.2f} s long, B {seconds[1]:.2f} s"
        start = f", B begins {offset:g} s after A" if offset else ", both from their first frame on"
        yield f"{lengths}{start}: {count / rate_hz:.2f} s are compared."


def shared_levels(a: Moving, b: Moving) -> tuple[BodyModel, BodyModel] | None:
    """The levels of detail of both bodies whose meshes are one, the coarsest such; None where no
    two are.
    """
    levels = ([level for level in (m.body, m.body.full) if level is not None] for m in (a, b))
    for one, other in product(*levels):
        if one.num_vertices == other.num_vertices and np.array_equal(one.faces, other.faces):
            return one, other
    return None


def shared_joints(a: Moving, b: Moving) -> tuple[tuple[str, ...], np.ndarray, np.ndarray]:
    """The joints whose names both have, in A's order, and their numbers in A and in B."""
    names = tuple(name for name in a.body.joint_names if name in b.body.joint_names)
    at = (np.array([m.body.joint_names.index(name) for name in names], np.int64) for m in (a, b))
    return names, *at


def surfaces_at(
    moving: Moving, frames: Float[np.ndarray, " T"], body: BodyModel | None, skin: bool
) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Vertices (t, V, 3) and joints (t, J, 3) at some moments, a few at a time, linear between two
    frames.

    Without ``skin`` there is one vertex only.
    """
    some = None if skin else [0]
    for start in range(0, len(frames), _BATCH):
        part = frames[start : start + _BATCH]
        low = np.floor(part).astype(np.int64)
        share = (part - low)[:, None, None]
        found = next(moving.surfaces(low, some, body))
        vertices = np.asarray(found.vertices)
        joints = np.asarray(found.joints)
        if share.any():
            then = next(moving.surfaces(np.minimum(low + 1, moving.num_frames - 1), some, body))
            vertices = (1 - share) * vertices + share * np.asarray(then.vertices)
            joints = (1 - share) * joints + share * np.asarray(then.joints)
        yield vertices, joints


def points_at(
    points: Float[np.ndarray, "T M 3"], frames: Float[np.ndarray, " T"]
) -> Float[np.ndarray, "T M 3"]:
    """Points of every frame at some moments, linear between two frames."""
    low = np.floor(frames).astype(np.int64)
    share = (frames - low)[:, None, None]
    return (1 - share) * points[low] + share * points[np.minimum(low + 1, len(points) - 1)]
