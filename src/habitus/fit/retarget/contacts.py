"""Foot contacts: points of the soles, when they are still, the ground below them, and how far feet
have to move so that they stand where they stood.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.ndimage import binary_closing, binary_opening

from habitus.body.measurements import SoleSettings


@dataclass(frozen=True)
class ContactSettings(SoleSettings):
    """Where the soles are, and when a point of one stands: slow for long enough."""

    speed: float = 0.2
    """Metres a second; feet of walking people move at 1 to 5 in the swing."""
    shortest: float = 0.08
    """Seconds of a stand, at least."""
    hole: float = 0.04
    """Seconds of more speed that do not interrupt a stand."""
    floor_tolerance: float = 0.04
    """Metres by which heights of one floor differ."""


CONTACTS = ContactSettings()


def standing(
    points: Float[np.ndarray, "T ... 3"], rate_hz: float, settings: ContactSettings = CONTACTS
) -> Bool[np.ndarray, "T ..."]:
    """When points stand: slower than ``speed`` for at least ``shortest`` seconds."""
    frames = len(points)
    if frames < 2:
        return np.zeros(points.shape[:-1], bool)
    step = max(1, round(0.025 * rate_hz))
    before = np.maximum(np.arange(frames) - step, 0)
    after = np.minimum(np.arange(frames) + step, frames - 1)
    way = np.linalg.norm(points[after] - points[before], axis=-1)
    still = way * rate_hz / (after - before).reshape(-1, *[1] * (way.ndim - 1)) < settings.speed
    line = np.ones(
        (2 * max(0, round(0.5 * settings.hole * rate_hz)) + 1, *[1] * (way.ndim - 1)), bool
    )
    run = np.ones((max(1, round(settings.shortest * rate_hz)), *[1] * (way.ndim - 1)), bool)
    return binary_opening(still | binary_closing(still, line), run)


def ground_height(
    heights: Float[np.ndarray, "T ..."],
    still: Bool[np.ndarray, "T ..."],
    settings: ContactSettings = CONTACTS,
) -> float:
    """The height of the floor that is stood on most, among the lowest; without any standing the
    lowest height.
    """
    if not still.any():
        return float(np.percentile(heights, 1))
    low = np.where(still, heights, np.inf).reshape(len(heights), -1).min(axis=1)
    low = low[np.isfinite(low)]
    return float(np.median(low[low <= np.percentile(low, 10) + settings.floor_tolerance]))


class Stand(NamedTuple):
    """Frames ``first`` to ``last`` in which some point of a foot stands; ``active`` (n,) says
    which, frame by frame.
    """

    first: int
    last: int
    active: Int[np.ndarray, " n"]


def stands(still: Bool[np.ndarray, "T P"]) -> Iterator[Stand]:
    """Every run of frames in which a point of a foot stands, one point after the other as long as
    it does.
    """
    active = np.full(len(still), -1)
    now = -1
    for frame, here in enumerate(still):
        if now < 0 or not here[now]:
            points = np.flatnonzero(here).tolist()
            now = max(points, key=lambda point: _until(still, frame, point), default=-1)
        active[frame] = now
    edges = np.flatnonzero(np.diff((active >= 0).astype(np.int8), prepend=0, append=0))
    for first, end in zip(edges[::2], edges[1::2], strict=True):
        yield Stand(int(first), int(end) - 1, active[first:end])


def _until(still: np.ndarray, frame: int, point: int) -> int:
    """How many frames a point goes on standing."""
    moves = np.flatnonzero(~still[frame:, point])
    return int(moves[0]) if len(moves) else len(still) - frame


def corrections(
    moved: Float[np.ndarray, "T P 3"],
    still: Bool[np.ndarray, "T P"],
    as_before: Float[np.ndarray, "T P 3"],
) -> Float[np.ndarray, "T 3"]:
    """What a foot has to be shifted by, frame by frame, with y up.

    ``moved``: the points of the foot as they are, ``as_before``: as they were in the source, y as
    it shall be. While a point stands it goes where it went in the source, which was nowhere to
    speak of; where it stands is where it is on average, and as high as it shall be. In between the
    shift goes smoothly from one stand's to the next's.
    """
    out = np.zeros((len(moved), 3))
    known = np.zeros(len(moved), bool)
    for stand in stands(still):
        frames = np.arange(stand.first, stand.last + 1)
        point = stand.active
        offsets = as_before[frames, point] - moved[frames, point]
        shift = _chained(as_before - moved, frames, point)
        shift[:, [0, 2]] -= shift[:, [0, 2]].mean(axis=0)
        shift[:, 1] += offsets[:, 1].mean() - shift[:, 1].mean()
        out[frames], known[frames] = shift, True
    return bridged(out, known)


def _chained(
    offsets: np.ndarray, frames: np.ndarray, point: np.ndarray
) -> Float[np.ndarray, "n 3"]:
    """The change of what parts the standing point from its source, going on without a jump where
    the point changes.
    """
    shift = np.zeros((len(frames), 3))
    for k in range(1, len(frames)):
        shift[k] = (
            shift[k - 1] + offsets[frames[k], point[k - 1]] - offsets[frames[k - 1], point[k - 1]]
        )
    return shift


def bridged(shift: np.ndarray, known: np.ndarray) -> Float[np.ndarray, "T 3"]:
    """Between known frames a way that begins and ends at rest; before the first and after the last
    it holds.
    """
    if not known.any():
        return shift
    frames = np.flatnonzero(known)
    after = np.clip(np.searchsorted(frames, np.arange(len(shift))), 0, len(frames) - 1)
    before = np.maximum(after - (frames[after] > np.arange(len(shift))), 0)
    first = frames[before]
    last = frames[after]
    share = np.clip((np.arange(len(shift)) - first) / np.maximum(last - first, 1), 0.0, 1.0)
    smooth = (share**2 * (3.0 - 2.0 * share))[:, None]
    return shift[first] + smooth * (shift[last] - shift[first])
