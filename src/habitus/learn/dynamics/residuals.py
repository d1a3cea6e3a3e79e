"""What the body does not say of a moving surface, carried back to the rest pose (S 6)."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from habitus.body.model import BodyModel
from habitus.learn.dynamics.sequences import MovingSurface
from habitus.learn.posing.rig import Rig
from habitus.learn.posing.surface import posed
from habitus.parallel.workers import Workers

_BLOCK = 64  # frames carried back together
SQUEEZED = 0.5
"""Where skinning leaves less of a volume than this share, what it did is not undone to the full."""
DAMPING = 0.1
"""How much of what is squeezed flat is given up (added to the squared scale)."""


@dataclass(frozen=True, eq=False)
class _Shared:
    body: BodyModel
    rig: Rig
    sequences: Sequence[MovingSurface]


def rest_residuals(
    body: BodyModel, sequences: Sequence[MovingSurface], workers: Workers
) -> Iterator[tuple[int, Float[np.ndarray, "n M"]]]:
    """Which sequence, and the residuals (m; M = 3 V, vertex by vertex) of its next frames: sequence
    after sequence.

    Sequences know betas, pose and trans. Vertices that are not seen in a frame, of weight 0, count
    as not moved, others as much as they are trusted.
    """
    rig = Rig(
        body.parents, body.skinning, body.pose_features, body.shape_features,
        body.skinning_index, body.skinning_value, None,
    )  # fmt: skip
    shared = _Shared(body, rig, sequences)
    items = [(k, first) for k, one in enumerate(sequences) for first in range(0, len(one), _BLOCK)]
    for (k, _), block in zip(items, workers.map(_block, shared, items), strict=True):
        yield k, block


def _block(shared: _Shared, item: tuple[int, int]) -> Float[np.ndarray, "n M"]:
    sequence = shared.sequences[item[0]]
    first = item[1]
    frames = range(first, min(first + _BLOCK, len(sequence)))
    return np.stack([away.ravel() for away in _residuals(shared, sequence, frames)])


def _residuals(
    shared: _Shared, sequence: MovingSurface, frames: range
) -> Iterator[Float[np.ndarray, "V 3"]]:
    body = shared.body
    pose = sequence.pose
    trans = sequence.trans
    assert pose is not None and trans is not None
    ids = slice(None) if sequence.vertex_ids is None else sequence.vertex_ids
    if sequence.still is not None:
        source = sequence.still
        still = [np.asarray(source[frame], float) for frame in frames]
    else:
        some = slice(frames.start, frames.stop)
        still = list(body(sequence.betas, pose[some], trans[some]).vertices[:, ids])
    for frame, at_rest in zip(frames, still, strict=True):
        found, weight = sequence.registrations.read_seen(frame)
        away = np.zeros((body.num_vertices, 3))
        away[ids] = found - at_rest
        if weight is not None:
            away[ids] *= weight[:, None]
        yield unposed(posed(shared.rig, pose[frame]).turn, away)


def unposed(
    turn: Float[np.ndarray, "V 3 3"], away: Float[np.ndarray, "V 3"]
) -> Float[np.ndarray, "V 3"]:
    """Offsets d at rest with turn d = away, for the blended rotations of skinning.

    Where these squeeze a volume below `SQUEEZED` of itself (deep folds, strong twists), d is the
    minimum of
    |turn d - away|^2 + mu |d|^2 instead; mu rises smoothly from 0 there to `DAMPING` where nothing is left.
    """  # noqa: E501
    a = turn[:, 0]
    b = turn[:, 1]
    c = turn[:, 2]
    across = np.cross(b, c), np.cross(c, a), np.cross(a, b)
    volume = np.einsum("vi,vi->v", a, across[0])
    flat = volume < SQUEEZED
    total = sum(side * away[:, k, None] for k, side in enumerate(across))
    found = total / np.where(flat, 1.0, volume)[:, None]
    if flat.any():
        mu = DAMPING * (1.0 - np.maximum(volume[flat], 0.0) / SQUEEZED) ** 2
        back = turn[flat].swapaxes(-1, -2)
        matrix = back @ turn[flat] + mu[:, None, None] * np.eye(3)
        found[flat] = np.linalg.solve(matrix, back @ away[flat][..., None])[..., 0]
    return found
