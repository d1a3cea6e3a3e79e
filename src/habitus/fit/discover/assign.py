"""Which label sits where on the skin, softly: expectation maximisation over bodies in several
frames at once.

A label m has a posterior over the K places of a skin, from its squared distances to them averaged
over the frames, since it sits at one place in all of them. A place is drawn to the mean of the
labels that may sit there. What is further than `OUTLIER` sigmas from everything may sit nowhere.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from habitus.body.prior import PosePrior
from habitus.fit.markers.sequence import fit_sequence
from habitus.fit.markers.settings import SequenceSettings
from habitus.observe.marker_prediction import MarkedBody, predict
from habitus.solve.sequence.solver import SequenceOptions

DATA = 7500.0
"""Weight of squared distances where places are known well (M eq. 3), per m^2; less by how firm the
pose prior is.
"""
OUTLIER = 3.5
_LEAST = 0.02  # a place that has less of all labels than this is nobody's

Known = Float[np.ndarray, "M K"] | float
"""Logarithms of what is known of labels' places before: 0 where nothing is."""
Schedule = tuple[tuple[float, float], ...]
"""Steps of (sigma in metres, firmness of the pose prior)."""


@dataclass(frozen=True)
class Bodies:
    """N bodies in the same F frames each: pose, trans, cost of each, and the posteriors of M labels
    over K places.
    """

    pose: Float[np.ndarray, "N F J 3"]
    trans: Float[np.ndarray, "N F 3"]
    cost: Float[np.ndarray, " N"]
    posterior: Float[np.ndarray, "N M K"]

    def of(self, rows: Int[np.ndarray, " n"]) -> "Bodies":
        """Some of the bodies."""
        return Bodies(self.pose[rows], self.trans[rows], self.cost[rows], self.posterior[rows])


def squared_distances(
    places: Float[np.ndarray, "N F K 3"], observed: Float[np.ndarray, "F M 3"]
) -> Float[np.ndarray, "N M K"]:
    """Squared distances of labels from places, averaged over the frames in which a label is seen
    (m^2).
    """
    seen = np.isfinite(observed[..., 0])
    middle = np.nan_to_num(observed).sum(axis=1) / np.maximum(seen.sum(axis=1), 1)[:, None]
    x = np.where(seen[..., None], observed - middle[:, None], 0.0)
    s = places - middle[:, None]
    count = np.maximum(seen.sum(axis=0), 1)
    own = np.sum(x**2, axis=(0, 2)) / count
    theirs = np.einsum("fm,nfk->nmk", seen / count, np.sum(s**2, axis=3), optimize=True)
    n, f, k, _ = s.shape
    both = np.swapaxes(x, 1, 2).reshape(3 * f, -1).T @ np.swapaxes(s, 2, 3).reshape(n, 3 * f, k)
    return np.maximum(own[:, None] + theirs - 2.0 * both / count[:, None], 0.0)


def posteriors(
    squared: Float[np.ndarray, "N M K"], sigma: float, known: Known = 0.0
) -> tuple[Float[np.ndarray, "N M K"], Float[np.ndarray, "N M"]]:
    """Posteriors over places, which sum to less than 1 for a label that may sit nowhere, and free
    energies (m^2).
    """
    likely = np.exp(known - squared / (2.0 * sigma**2))
    total = likely.sum(axis=2, keepdims=True) + np.exp(-0.5 * OUTLIER**2)
    return likely / total, -2.0 * sigma**2 * np.log(total[..., 0])


def posed(
    rig: MarkedBody,
    observed: Float[np.ndarray, "F M 3"],
    posterior: Float[np.ndarray, "N M K"],
    prior: PosePrior,
    pose: Float[np.ndarray, "N F J 3"],
    trans: Float[np.ndarray, "N F 3"],
    firmness: float,
    sweeps: int = 3,
) -> tuple[Float[np.ndarray, "N F J 3"], Float[np.ndarray, "N F 3"], Float[np.ndarray, "N F"]]:
    """Poses that bring places to their labels, ``firmness`` times the pose prior, and each frame's
    cost.
    """
    seen = np.isfinite(observed[..., 0]).astype(float)
    weight = np.einsum("fm,nmk->nfk", seen, posterior, optimize=True)
    mass = np.einsum("fmd,nmk->nfkd", np.nan_to_num(observed), posterior, optimize=True)
    target = np.where(
        (weight < _LEAST)[..., None], np.nan, mass / np.maximum(weight, _LEAST)[..., None]
    )
    options = SequenceOptions(strides=(1,), sweeps=sweeps, tolerance=1e-2)
    settings = SequenceSettings(data=DATA / firmness, acceleration=0.0, options=options)
    n, f, k = weight.shape
    start = (pose.reshape(n * f, -1, 3), trans.reshape(n * f, 3))
    found = fit_sequence(
        rig,
        target.reshape(n * f, k, 3),
        weight.reshape(n * f, k),
        None,
        prior,
        *start,
        settings=settings,
    )
    return (
        found.pose.reshape(pose.shape),
        found.trans.reshape(trans.shape),
        found.frame_costs.reshape(n, f),
    )


def settled(
    rig: MarkedBody,
    observed: Float[np.ndarray, "F M 3"],
    prior: PosePrior,
    pose: Float[np.ndarray, "N F J 3"],
    trans: Float[np.ndarray, "N F 3"],
    schedule: Schedule,
    known: Known = 0.0,
) -> Bodies:
    """Posteriors and poses in turn, through a schedule."""
    for sigma, firmness in schedule:
        posterior, _ = posteriors(
            squared_distances(places_of(rig, pose, trans), observed), sigma, known
        )
        pose, trans, _ = posed(rig, observed, posterior, prior, pose, trans, firmness)
    squared = squared_distances(places_of(rig, pose, trans), observed)
    posterior, energy = posteriors(squared, schedule[-1][0], known)
    away = pose[:, :, 1:].reshape(*pose.shape[:2], -1) - prior.mean
    unlikely = np.sum((away @ prior.whitening.T) ** 2, axis=2).mean(axis=1)
    return Bodies(pose, trans, 0.5 * (DATA / UNSURE * energy.sum(axis=1) + unlikely), posterior)


UNSURE = 10.0
"""How much less than `DATA` squared distances weigh in the cost: a body that is not this person's
errs in all alike.
"""


def places_of(
    rig: MarkedBody, pose: Float[np.ndarray, "N F J 3"], trans: Float[np.ndarray, "N F 3"]
) -> Float[np.ndarray, "N F K 3"]:
    """Where the places of a rig are."""
    n, f = pose.shape[:2]
    return predict(rig, pose.reshape(n * f, -1, 3), trans.reshape(n * f, 3)).reshape(n, f, -1, 3)
