"""Labels of tracklets: votes of single registered frames, costs averaged over a tracklet's points
and matched frame by frame, and how certain each label is.
"""

import numpy as np
from jaxtyping import Float, Int

from habitus.fit.labels.clouds import Clouds
from habitus.fit.labels.kernels import assign_frames, squared_distances
from habitus.fit.labels.registration import Registered
from habitus.fit.labels.settings import VOTES, VoteSettings


def distances(
    clouds: Clouds, predicted: Float[np.ndarray, "T M 3"], settings: VoteSettings = VOTES
) -> Float[np.ndarray, "P M"]:
    """Squared distance (m^2) of each point from each predicted marker of its frame, cut at
    ``max_distance``.
    """
    out = np.empty((len(clouds.points), predicted.shape[1]))
    squared_distances(clouds.points, clouds.start, predicted, settings.max_distance**2, out)
    return out


def averaged(
    values: Float[np.ndarray, "P M"], tracklet: Int[np.ndarray, " P"]
) -> Float[np.ndarray, "P M"]:
    """Each point's values as the mean over its tracklet."""
    order = np.argsort(tracklet, kind="stable")
    first = np.flatnonzero(np.diff(tracklet[order], prepend=-1))
    sums = np.add.reduceat(values[order], first, axis=0)
    counts = np.diff(np.append(first, len(order)))
    return (sums / counts[:, None])[tracklet]


def assign(
    costs: Float[np.ndarray, "P M"], clouds: Clouds, gates: Float[np.ndarray, " P"]
) -> Int[np.ndarray, " P"]:
    """The label of each point, -1 where every one costs more than its gate; no label twice in a
    frame.
    """
    label = np.empty(len(costs), dtype=np.int64)
    assign_frames(np.ascontiguousarray(costs), clouds.start, gates, label)
    return label


def judged(
    squared: Float[np.ndarray, "P M"],
    label: Int[np.ndarray, " P"],
    tracklet: Int[np.ndarray, " P"],
    clouds: Clouds,
    sure: Float[np.ndarray, " M"],
    settings: VoteSettings = VOTES,
) -> tuple[Int[np.ndarray, " P"], Float[np.ndarray, " P"]]:
    """Labels less those that are not likely, and each point's confidence in its label or in the
    best one refused.
    """
    known = label >= 0
    rows = np.flatnonzero(known)
    own = np.sqrt(squared[rows, label[rows]])
    spread = np.full(squared.shape[1], settings.min_spread)
    typical = np.median(own) if len(own) else settings.min_spread
    for i in range(len(spread)):
        mine = own[label[rows] == i]
        spread[i] = np.clip(
            np.median(mine) if len(mine) else typical,
            settings.min_spread,
            max(2.0 * typical, settings.min_spread),
        )
    off = averaged(np.minimum(squared / (2.0 * spread**2), 50.0), tracklet)
    alone = np.minimum(squared / (2.0 * spread**2), 50.0)
    likely = np.exp(-off)
    share = likely / (likely.sum(axis=1, keepdims=True) + settings.nothing)
    best = np.where(known, label, share.argmax(axis=1))
    each = np.arange(len(label))
    confidence = share[each, best] * sure[best]
    kept = known & (share[each, best] >= settings.likely) & (alone[each, best] < settings.farthest)
    return np.where(kept, label, -1), confidence


def seed_votes(
    clouds: Clouds,
    seeds: Registered,
    tracklet: Int[np.ndarray, " P"],
    count: int,
    settings: VoteSettings = VOTES,
) -> tuple[Int[np.ndarray, " P"], Float[np.ndarray, " F"]]:
    """The label of each point by what good seeds call its tracklet, -1 for none; and the share of
    each seed's labels that the others share.
    """
    least = float(seeds.cost.min())
    own = np.exp(-(seeds.cost - least) / (0.5 * least + 50.0))
    voters, named = np.nonzero(seeds.match >= 0)
    pieces = tracklet[seeds.match[voters, named]]
    weight = own
    agreed = np.ones(len(own))
    for _ in range(settings.rounds):
        votes = np.zeros((int(tracklet.max()) + 1, count))
        np.add.at(votes, (pieces, named), weight[voters])
        winner = votes.argmax(axis=1)
        total = votes.sum(axis=1)
        shared = total[pieces] - weight[voters] > 1e-9
        right = shared & (winner[pieces] == named)
        seen = np.bincount(voters[shared], minlength=len(own))
        agreed = np.where(
            seen > 0, np.bincount(voters[right], minlength=len(own)) / np.maximum(seen, 1), 1.0
        )
        weight = own * agreed**4
    strength = votes.max(axis=1)
    label = np.where((strength > 0) & (strength > settings.clear * total), winner, -1)[tracklet]
    return without_duplicates(label, strength[tracklet], clouds), agreed


def without_duplicates(
    label: Int[np.ndarray, " P"], strength: Float[np.ndarray, " P"], clouds: Clouds
) -> Int[np.ndarray, " P"]:
    """No label twice in a frame: the stronger point keeps it."""
    order = np.lexsort((-strength, label, clouds.frame))
    frame = clouds.frame[order]
    again = (np.diff(frame, prepend=-1) == 0) & (np.diff(label[order], prepend=-2) == 0)
    kept = label.copy()
    kept[order[again]] = -1
    return kept


def best_seeds(
    seeds: Registered, agreed: Float[np.ndarray, " F"], count: int = VOTES.shape_seeds
) -> Int[np.ndarray, " N"]:
    """The cheapest seeds that the others agree with."""
    order = np.argsort(seeds.cost / np.maximum(agreed, 0.1) ** 2, kind="stable")
    return order[:count]
