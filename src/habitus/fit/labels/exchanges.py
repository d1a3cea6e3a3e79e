"""Labels of close markers: what exchanging them would cost, by placements and by how joints bend.

A wrong label pulls the fit along and then looks right, so poses are solved again for each exchange,
in some frames.
"""

import numpy as np
from jaxtyping import Float, Int

from habitus.body.prior import PosePrior
from habitus.fit.labels.clouds import Clouds
from habitus.fit.labels.settings import EXCHANGES, ExchangeSettings
from habitus.fit.markers.marker_sequence import marker_sequence
from habitus.fit.markers.settings import SequenceSettings
from habitus.observe.marker_prediction import MarkedBody, predict
from habitus.solve.sequence import LevelFrames, share_out


def resolve_exchanges(
    rig: MarkedBody,
    prior: PosePrior,
    clouds: Clouds,
    tracklet: Int[np.ndarray, " P"],
    label: Int[np.ndarray, " P"],
    frames: Int[np.ndarray, " F"],
    state: tuple[Float[np.ndarray, "F J 3"], Float[np.ndarray, "F 3"]],
    weights: Float[np.ndarray, " M"],
    settings: ExchangeSettings = EXCHANGES,
) -> tuple[Int[np.ndarray, " P"], Float[np.ndarray, " M"]]:
    """Labels with those exchanged, tracklet by tracklet, whose exchange is cheaper; and how sure
    each label is of its nearest rival (0.5: not at all).

    frames and their state: what is looked at. weights: of the markers' squared distances, per m^2.
    """
    pairs = near_pairs(predict(rig, *state), settings.distance)
    for _ in range(settings.rounds):
        columns = _columns(clouds, label, frames, rig.num_markers)
        change = _changes(rig, prior, clouds, columns, state, weights, pairs, settings.sweeps)
        exchanged = _cheaper(change, columns, tracklet, pairs)
        if not exchanged:
            break
        label = label.copy()
        for piece, new in exchanged.items():
            label[tracklet == piece] = new
    sure = np.ones(rig.num_markers)
    known = np.isfinite(change)
    mean = np.where(known, change, 0.0).sum(axis=1) / np.maximum(known.sum(axis=1), 1)
    each = np.where(
        known.any(axis=1),
        1.0 / (1.0 + np.exp(-settings.certainty * np.clip(mean, -50.0, 50.0))),
        1.0,
    )
    for side in range(2):
        np.minimum.at(sure, pairs[:, side], each)
    return label, sure


def near_pairs(
    predicted: Float[np.ndarray, "F M 3"], distance: float = EXCHANGES.distance
) -> Int[np.ndarray, "K 2"]:
    """Pairs of markers that are near each other."""
    between = np.linalg.norm(predicted[:, :, None] - predicted[:, None], axis=3)
    first, second = np.nonzero(np.triu(np.median(between, axis=0) < distance, 1))
    return np.stack([first, second], axis=1)


def _columns(
    clouds: Clouds, label: np.ndarray, frames: np.ndarray, count: int
) -> Int[np.ndarray, "F M"]:
    """The point of each label in some frames, -1 for none."""
    columns = np.full((len(frames), count), -1)
    for row, t in enumerate(frames):
        points = np.arange(int(clouds.start[t]), int(clouds.start[t + 1]))
        points = points[label[points] >= 0]
        columns[row, label[points]] = points
    return columns


def _changes(
    rig: MarkedBody,
    prior: PosePrior,
    clouds: Clouds,
    columns: np.ndarray,
    state: tuple[np.ndarray, np.ndarray],
    weights: np.ndarray,
    pairs: np.ndarray,
    sweeps: int,
) -> Float[np.ndarray, "K F"]:
    """How much more each frame costs with a pair exchanged, NaN where neither is seen."""
    orders = np.tile(np.arange(columns.shape[1]), (len(pairs) + 1, 1))
    rows = np.arange(1, len(pairs) + 1)
    orders[rows, pairs[:, 0]], orders[rows, pairs[:, 1]] = pairs[:, 1], pairs[:, 0]
    observed = np.where((columns >= 0)[..., None], clouds.points[columns], np.nan)
    costs = exchange_costs(rig, prior, observed, *state, weights, orders, sweeps)
    seen = (columns[:, pairs] >= 0).any(axis=2).T
    return np.where(seen, costs[1:] - costs[0], np.nan)


def _cheaper(
    change: np.ndarray, columns: np.ndarray, tracklet: np.ndarray, pairs: np.ndarray
) -> dict[int, int]:
    """Tracklet -> its new label, for exchanges that save something and do not touch each other."""
    offers: list[tuple[float, int, dict[int, int]]] = []
    for k, (i, j) in enumerate(pairs.tolist()):
        pieces = np.where(columns[:, [i, j]] >= 0, tracklet[columns[:, [i, j]]], -1)
        for a, b in np.unique(pieces, axis=0).tolist():
            rows = (pieces == (a, b)).all(axis=1)
            saved = (
                -float(np.nanmean(change[k, rows])) if np.isfinite(change[k, rows]).any() else 0.0
            )
            if saved > 1e-3:
                moved = {piece: new for piece, new in ((a, j), (b, i)) if piece >= 0}
                offers.append((saved * rows.sum(), k, moved))
    taken: dict[int, int] = {}
    used: set[int] = set()
    for _, k, moved in sorted(offers, key=lambda offer: -offer[0]):
        near = {*pairs[k].tolist()}
        if not (used & near) and not (set(moved) & set(taken)):
            taken |= moved
            used |= near
    return taken


def exchange_costs(
    rig: MarkedBody,
    prior: PosePrior,
    observed: Float[np.ndarray, "F M 3"],
    pose: Float[np.ndarray, "F J 3"],
    trans: Float[np.ndarray, "F 3"],
    weights: Float[np.ndarray, " M"],
    orders: Int[np.ndarray, "K M"],
    sweeps: int = EXCHANGES.sweeps,
) -> Float[np.ndarray, "K F"]:
    """What each frame costs with its markers in each order (order[i] is the column that marker i
    takes), the poses found anew.
    """
    given = observed[:, orders].transpose(1, 0, 2, 3).reshape(-1, *observed.shape[1:])
    share = np.broadcast_to(weights, given.shape[:2])
    problem = marker_sequence(
        rig, given, share, None, prior, SequenceSettings(data=1.0, acceleration=0.0), 0
    )
    states = problem.pack(
        np.tile(pose, (len(orders), 1, 1)), np.tile(trans, (len(orders), 1)), None
    )
    level = side_by_side(states, problem.pose_end, 10.0)
    for _ in range(sweeps):
        share_out(problem, lambda some: problem.visit(level, some), level.frames)
    return level.costs.reshape(len(orders), len(observed))


def side_by_side(states: Float[np.ndarray, "F N"], pose_end: int, damping: float) -> LevelFrames:
    """States as a level of `habitus.solve.sequence` without links: each frame by itself.

    A special case of `habitus.fit.markers.sequence` at one level: the terms "data" and "pose" of
    `habitus.fit.markers.energy.sequence_terms`, thousands of frames side by side in compiled,
    damped Gauss-Newton steps. A step is taken only where it lowers its frame's cost (else the
    damping grows), so that a fixed number of visits can stop early but not diverge.
    """
    count = len(states)
    return LevelFrames(
        frames=np.arange(count),
        states=states,
        links=np.zeros((count + 2, states.shape[1])),
        costs=np.zeros(count),
        damping=np.full(count, damping),
        moved=np.zeros(count),
        cost_decrease=np.zeros(count),
        relaxations=np.ones(count),
        measured=slice(3, pose_end),
    )
