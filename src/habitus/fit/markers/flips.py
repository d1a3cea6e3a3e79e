"""Labels that two markers exchange from one frame to the next, found in the markers alone, before
any body is fitted.

A marker goes on as it moved. Where two jump at once, each to where the other would have been, they
changed labels; and their distances from all others tell whether they did.
"""

import warnings
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from habitus.parallel.blocks import columns, release

JUMP = 0.03
"""Metres off the straight way on, at least."""
ALIKE = 0.35
"""How near the other's way they come, as a share of how far both are off their own."""
LONGEST = 6
"""Frames that a marker may be unseen before it jumps, and by which two jumps may differ."""
ENOUGH = 1000
"""Frames of either kind that are looked at."""
SMOOTH = 5e-3
"""Metres by which distances between markers differ in any case."""
FEWEST_FRAMES = 3


class _Jump(NamedTuple):
    marker: int
    frame: int
    place: np.ndarray
    expected: np.ndarray
    speed: np.ndarray


def find_flips(
    observed: Float[np.ndarray, "T M 3"],
) -> list[tuple[int, int, Bool[np.ndarray, " T"]]]:
    """Pairs that carry each other's label for the smaller part of the capture: (i, j, frames (T,)
    bool).

    observed (T, M, 3), metres, NaN where missing.
    """
    turns: dict[tuple[int, int], list[int]] = {}
    for first, second in _crossings(_jumps(observed)):
        pair = (min(first.marker, second.marker), max(first.marker, second.marker))
        turns.setdefault(pair, []).append(max(first.frame, second.frame))
    parts = ((*pair, _smaller_part(len(observed), at)) for pair, at in turns.items())
    return [
        (i, j, frames)
        for i, j, frames in parts
        if frames.any() and _confirmed(observed, i, j, frames)
    ]


def _crossings(jumps: list[_Jump]) -> list[tuple[_Jump, _Jump]]:
    """Pairs of jumps that cross, each jump in one pair at most, the surest first."""
    jumps = sorted(jumps, key=lambda jump: jump.frame)
    likely = []
    for k, first in enumerate(jumps):
        for n in range(k + 1, len(jumps)):
            second = jumps[n]
            if second.frame - first.frame > LONGEST:
                break
            if (
                first.marker != second.marker
                and (share := _off_the_others_way(first, second)) < ALIKE
            ):
                likely.append((share, k, n))
    used: set[int] = set()
    return [
        (jumps[k], jumps[n])
        for _, k, n in sorted(likely)
        if not {k, n} & used and not used.update((k, n))
    ]


def _jumps(observed: np.ndarray) -> list[_Jump]:
    found = []
    for marker, column in enumerate(columns(observed)):
        frames = np.flatnonzero(np.isfinite(column[:, 0]))
        if len(frames) < 4:
            continue
        places = column[frames]
        steps = np.diff(frames)
        speed = np.diff(places, axis=0) / steps[:, None]
        speed[steps > LONGEST] = 0.0
        expected = places[1:-1] + speed[:-1] * steps[1:, None]
        off = np.linalg.norm(places[2:] - expected, axis=1)
        at = np.flatnonzero((off > JUMP) & (steps[1:] <= LONGEST))
        rows = zip(frames[at + 2].tolist(), places[at + 2], expected[at], speed[at], strict=True)
        found += [_Jump(marker, *row) for row in rows]
    return found


def _off_the_others_way(first: _Jump, second: _Jump) -> float:
    """How far each is from where the other would have been, as a share of how far both are off
    their own way.
    """
    late = second.frame - first.frame
    there = np.linalg.norm(first.place - (second.expected - late * second.speed))
    back = np.linalg.norm(second.place - (first.expected + late * first.speed))
    own = np.linalg.norm(first.place - first.expected) + np.linalg.norm(
        second.place - second.expected
    )
    return float((there + back) / own)


def _confirmed(observed: np.ndarray, i: int, j: int, frames: np.ndarray) -> bool:
    """Whether the pair's distances from what goes with it are in these frames far more the usual
    ones if exchanged.
    """
    others = np.delete(np.arange(observed.shape[1]), [i, j])
    sides = [np.flatnonzero(frames == side) for side in (True, False)]
    some = np.sort(np.concatenate([side[:: -(-len(side) // ENOUGH)] for side in sides]))
    whole = observed
    observed = observed[some]
    frames = frames[some]
    release(whole)
    way = np.linalg.norm(observed[:, [i, j], None] - observed[:, None, others], axis=3)
    with warnings.catch_warnings():
        warnings.simplefilter(
            "ignore", RuntimeWarning
        )  # a marker that is never seen beside the pair
        usual = np.nanmedian(way[~frames], axis=0)
        spread = np.nanmedian(np.abs(way[~frames] - usual), axis=0) + SMOOTH
        rigid = np.argsort(spread.sum(axis=0))[: max(4, len(others) // 6)]
        off = [((way[frames][:, order] - usual) / spread)[..., rigid] for order in ([0, 1], [1, 0])]
        own, crossed = (np.nanmedian(each**2) for each in off)
    return bool(crossed < 0.5 * own)


def _smaller_part(frames: int, turns: list[int]) -> np.ndarray:
    """Frames between every other turn, those that are fewer."""
    chosen = np.cumsum(np.bincount(turns, minlength=frames)) % 2 == 1
    chosen = chosen if 2 * chosen.sum() <= frames else ~chosen
    return chosen if chosen.sum() >= FEWEST_FRAMES else np.zeros(frames, dtype=bool)
