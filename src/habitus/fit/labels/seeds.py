"""From registered frames to names of tracklets: seeds vote, each as far as it is cheap and agrees
with the others.
"""

import numpy as np
from jaxtyping import Float, Int

from habitus.fit.labels.clouds import Clouds
from habitus.fit.labels.registration import Registered

ROUNDS = 4
CLEAR = 0.6
SHAPE_SEEDS = 10


def seed_votes(
    clouds: Clouds, seeds: Registered, tracklet: Int[np.ndarray, " P"], count: int
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
    for _ in range(ROUNDS):
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
    label = np.where((strength > 0) & (strength > CLEAR * total), winner, -1)[tracklet]
    return once(label, strength[tracklet], clouds), agreed


def once(
    label: Int[np.ndarray, " P"], strength: Float[np.ndarray, " P"], clouds: Clouds
) -> Int[np.ndarray, " P"]:
    """No label twice in a frame: the stronger point keeps it."""
    order = np.lexsort((-strength, label, clouds.frame))
    frame = clouds.frame[order]
    again = (np.diff(frame, prepend=-1) == 0) & (np.diff(label[order], prepend=-2) == 0)
    kept = label.copy()
    kept[order[again]] = -1
    return kept


def best_seeds(seeds: Registered, agreed: Float[np.ndarray, " F"]) -> Int[np.ndarray, " N"]:
    """The cheapest seeds that the others agree with."""
    order = np.argsort(seeds.cost / np.maximum(agreed, 0.1) ** 2, kind="stable")
    return order[:SHAPE_SEEDS]
