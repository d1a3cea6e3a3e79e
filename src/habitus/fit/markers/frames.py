"""Which frames the shape stage looks at: the paper's random ones, or spread poses with complete
markers.
"""

import numpy as np
from jaxtyping import Float, Int

PAIRS = 150
CANDIDATES = 600


def random_frames(
    observed: Float[np.ndarray, "T M 3"], count: int, seed: int
) -> Int[np.ndarray, " F"]:
    """``count`` frames with a marker in them, drawn at random (MoSh 6: 12 random frames)."""
    usable = np.flatnonzero(np.isfinite(observed[..., 0]).any(axis=1))
    chosen = np.random.default_rng(seed).choice(usable, size=min(count, len(usable)), replace=False)
    return np.sort(chosen)


def spread_frames(
    observed: Float[np.ndarray, "T M 3"], count: int, seed: int
) -> Int[np.ndarray, " F"]:
    """``count`` frames whose poses differ most among the most complete ones, each marker seen where
    it can be.

    Poses are compared by distances between pairs of markers, which do not change when the body
    moves as a whole.
    """
    seen = np.isfinite(observed[..., 0])
    usable = np.flatnonzero(seen.any(axis=1))
    complete = seen[usable].mean(axis=1)
    best = usable[complete >= np.quantile(complete, 0.5)]
    best = best[np.linspace(0, len(best) - 1, min(CANDIDATES, len(best))).astype(int)]
    chosen = _farthest(_pair_distances(observed[best], seed), min(count, len(best)))
    return np.sort(np.array(_cover(list(best[chosen]), seen), dtype=np.int64))


def _pair_distances(observed: np.ndarray, seed: int) -> np.ndarray:
    """(N, PAIRS) distances between random pairs of markers, unseen ones at their median."""
    pairs = np.random.default_rng(seed).integers(observed.shape[1], size=(PAIRS, 2))
    distance = np.linalg.norm(observed[:, pairs[:, 0]] - observed[:, pairs[:, 1]], axis=2)
    known = np.isfinite(distance).any(axis=0)
    middle = np.zeros(PAIRS)
    middle[known] = np.nanmedian(distance[:, known], axis=0)
    return np.where(np.isfinite(distance), distance, middle)


def _farthest(features: np.ndarray, count: int) -> list[int]:
    """Farthest-point sampling, begun at the sample nearest to the median."""
    chosen = [int(np.argmin(np.linalg.norm(features - np.median(features, axis=0), axis=1)))]
    nearest = np.full(len(features), np.inf)
    while len(chosen) < count:
        nearest = np.minimum(nearest, np.linalg.norm(features - features[chosen[-1]], axis=1))
        chosen.append(int(np.argmax(nearest)))
    return chosen


def _cover(frames: list[int], seen: np.ndarray, times: int = 3) -> list[int]:
    """Frames added until each marker that is ever seen is seen ``times`` times, as far as it can
    be.
    """
    for marker in range(seen.shape[1]):
        lacking = times - int(seen[frames, marker].sum())
        others = np.setdiff1d(np.flatnonzero(seen[:, marker]), frames)
        if lacking > 0 and len(others):
            picks = np.linspace(0, len(others) - 1, min(lacking, len(others))).astype(int)
            frames = frames + list(others[picks])
    return frames
