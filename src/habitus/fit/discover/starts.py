"""Candidates of a discovery: bodies in a few frames, from plain poses in many directions, and which
label sits where on the skin.

Labels are assigned softly, by expectation maximisation over bodies in several frames at once: label
m has a posterior over the K places of a skin,

    q_mk proportional to exp(known_mk - |x_m - s_k|^2 / (2 sigma^2)),

the squared distances averaged over the frames, since a label sits at one place in all of them. A
place is drawn to the mean of the labels that may sit there. A label further than ``outlier`` sigmas
from every place may sit nowhere. Sigma falls through a schedule, and with it the weight of the pose
prior.
"""

from dataclasses import dataclass
from itertools import product

import numpy as np
from jaxtyping import Float, Int

from habitus.body.model import BodyModel
from habitus.body.prior import PosePrior
from habitus.fit.discover.settings import DISCOVER, DiscoverSettings, Schedule
from habitus.fit.discover.skin import Skin
from habitus.fit.markers.sequence import fit_sequence
from habitus.fit.markers.settings import SequenceSettings
from habitus.fit.markers.start import PLAIN_POSES, plain_pose
from habitus.fit.search import best_of_tries, distinct_rows
from habitus.mesh.mirror import mirrored_joints
from habitus.observe.marker_prediction import MarkedBody, predict
from habitus.rotations import matrix_from_rotvec, procrustes, rotvec_from_matrix
from habitus.solve.sequence import SequenceOptions

Known = Float[np.ndarray, "M K"] | float
"""Logarithms of what is known of labels' places before: 0 where nothing is."""


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
    squared: Float[np.ndarray, "N M K"],
    sigma: float,
    known: Known = 0.0,
    outlier: float = DISCOVER.outlier,
) -> tuple[Float[np.ndarray, "N M K"], Float[np.ndarray, "N M"]]:
    """Posteriors over places, which sum to less than 1 for a label that may sit nowhere, and free
    energies (m^2).
    """
    likely = np.exp(known - squared / (2.0 * sigma**2))
    total = likely.sum(axis=2, keepdims=True) + np.exp(-0.5 * outlier**2)
    return likely / total, -2.0 * sigma**2 * np.log(total[..., 0])


def posed(
    rig: MarkedBody,
    observed: Float[np.ndarray, "F M 3"],
    posterior: Float[np.ndarray, "N M K"],
    prior: PosePrior,
    pose: Float[np.ndarray, "N F J 3"],
    trans: Float[np.ndarray, "N F 3"],
    firmness: float,
    sweeps: int,
    settings: DiscoverSettings = DISCOVER,
) -> tuple[Float[np.ndarray, "N F J 3"], Float[np.ndarray, "N F 3"], Float[np.ndarray, "N F"]]:
    """Poses that bring places to their labels, ``firmness`` times the pose prior, and each frame's
    cost.
    """
    seen = np.isfinite(observed[..., 0]).astype(float)
    weight = np.einsum("fm,nmk->nfk", seen, posterior, optimize=True)
    mass = np.einsum("fmd,nmk->nfkd", np.nan_to_num(observed), posterior, optimize=True)
    least = settings.min_weight
    target = np.where(
        (weight < least)[..., None], np.nan, mass / np.maximum(weight, least)[..., None]
    )
    options = SequenceOptions(strides=(1,), sweeps=sweeps, tolerance=settings.tolerance)
    stage_settings = SequenceSettings(
        data=settings.data / firmness, acceleration=0.0, options=options
    )
    n, f, k = weight.shape
    start = (pose.reshape(n * f, -1, 3), trans.reshape(n * f, 3))
    solution = fit_sequence(
        rig,
        target.reshape(n * f, k, 3),
        weight.reshape(n * f, k),
        None,
        prior,
        *start,
        settings=stage_settings,
    )
    return (
        solution.pose.reshape(pose.shape),
        solution.trans.reshape(trans.shape),
        solution.frame_costs.reshape(n, f),
    )


def settled(
    rig: MarkedBody,
    observed: Float[np.ndarray, "F M 3"],
    prior: PosePrior,
    pose: Float[np.ndarray, "N F J 3"],
    trans: Float[np.ndarray, "N F 3"],
    schedule: Schedule,
    known: Known = 0.0,
    settings: DiscoverSettings = DISCOVER,
) -> Bodies:
    """Posteriors and poses in turn, through a schedule."""
    for sigma, firmness in schedule:
        posterior, _ = posteriors(
            squared_distances(places_of(rig, pose, trans), observed), sigma, known, settings.outlier
        )
        pose, trans, _ = posed(
            rig, observed, posterior, prior, pose, trans, firmness, settings.sweeps, settings
        )
    squared = squared_distances(places_of(rig, pose, trans), observed)
    posterior, energy = posteriors(squared, schedule[-1][0], known, settings.outlier)
    away = pose[:, :, 1:].reshape(*pose.shape[:2], -1) - prior.mean
    unlikely = np.sum((away @ prior.whitening.T) ** 2, axis=2).mean(axis=1)
    data = settings.cost_share * settings.data
    return Bodies(pose, trans, 0.5 * (data * energy.sum(axis=1) + unlikely), posterior)


def places_of(
    rig: MarkedBody, pose: Float[np.ndarray, "N F J 3"], trans: Float[np.ndarray, "N F 3"]
) -> Float[np.ndarray, "N F K 3"]:
    """Where the places of a rig are."""
    n, f = pose.shape[:2]
    return predict(rig, pose.reshape(n * f, -1, 3), trans.reshape(n * f, 3)).reshape(n, f, -1, 3)


_POSES = (
    *PLAIN_POSES,
    {"hip": (-0.1, 0.0, 0.1), "knee": (1.7, 0.0, 0.0), "shoulder": (0.0, -0.3, -1.2)},
    {
        "hip": (-0.4, 0.0, 0.2),
        "knee": (2.2, 0.0, 0.0),
        "shoulder": (0.0, -0.6, -0.8),
        "elbow": (0.0, -0.6, 0.0),
    },
    {
        "hip": (-1.4, 0.0, 0.1),
        "knee": (1.4, 0.0, 0.0),
        "shoulder": (0.0, -1.3, -0.2),
        "elbow": (0.0, -0.1, 0.0),
    },
)  # the last three kneel, and are on all fours


def bodies_of_single_frames(
    body: BodyModel,
    rig: MarkedBody,
    skin: Skin,
    observed: Float[np.ndarray, "F M 3"],
    prior: PosePrior,
    known: Known = 0.0,
    settings: DiscoverSettings = DISCOVER,
) -> Bodies:
    """The cheapest bodies that differ, of single frames; each once more turned about (`turned`)."""
    directions = _directions()
    pose = np.array([plain_pose(body.joint_names, angles) for angles in _POSES]).repeat(
        len(directions), axis=0
    )
    pose[:, 0] = np.tile(directions, (len(_POSES), 1))
    around = np.median(places_of(rig, pose[:, None], np.zeros((len(pose), 1, 3)))[:, 0], axis=1)
    bodies = []
    for frame in _widest(observed, settings.start_frames):
        here = observed[frame : frame + 1]
        trans = np.nanmedian(here[0], axis=0) - around
        bodies.append(
            settled(
                rig, here, prior, pose[:, None], trans[:, None], settings.single, known, settings
            )
        )
    fields = (
        np.concatenate([getattr(each, name) for each in bodies]) for name in Bodies.__annotations__
    )
    kept = _that_differ(Bodies(*fields), skin, settings)
    about = turned(body, kept, skin)
    return Bodies(
        *(
            np.concatenate(pair)
            for pair in zip(vars(kept).values(), vars(about).values(), strict=True)
        )
    )


def turned(body: BodyModel, bodies: Bodies, skin: Skin) -> Bodies:
    """The bodies half a turn about their long axis, left and right exchanged: what fits the same
    markers nearly as well where no joint bends.
    """
    across = mirrored_joints(body.joint_names, body.parents)
    pose = bodies.pose[:, :, across] * np.array([1.0, -1.0, -1.0])
    root = matrix_from_rotvec(bodies.pose[:, :, 0]) @ np.diag([-1.0, 1.0, -1.0])
    pose[:, :, 0] = rotvec_from_matrix(root)
    return Bodies(pose, bodies.trans, bodies.cost, bodies.posterior[:, :, skin.across])


def in_all_frames(
    body: BodyModel,
    rig: MarkedBody,
    observed: Float[np.ndarray, "F M 3"],
    bodies: Bodies,
    prior: PosePrior,
    settings: DiscoverSettings = DISCOVER,
) -> Bodies:
    """Bodies of one frame in all frames, each by itself from every plain pose, labels where the one
    frame says.
    """
    count = len(bodies.pose)
    plain = [
        np.repeat(plain_pose(body.joint_names, angles)[None], count, axis=0) for angles in _POSES
    ]
    tries = []
    for start in (*plain, bodies.pose[:, 0]):
        pose, trans = _aligned(rig, start, observed, bodies.posterior)
        for firmness in settings.frame_prior:
            pose, trans, cost = posed(
                rig,
                observed,
                bodies.posterior,
                prior,
                pose,
                trans,
                firmness,
                settings.frame_sweeps,
                settings,
            )
        tries.append((pose, trans, cost))
    poses, places, costs = (np.stack(each) for each in zip(*tries, strict=True))
    pose, trans, cost = best_of_tries(costs, poses, places, costs)
    return Bodies(pose, trans, cost.sum(axis=1), bodies.posterior)


def _aligned(
    rig: MarkedBody,
    pose: Float[np.ndarray, "N J 3"],
    observed: Float[np.ndarray, "F M 3"],
    posterior: Float[np.ndarray, "N M K"],
) -> tuple[Float[np.ndarray, "N F J 3"], Float[np.ndarray, "N F 3"]]:
    """One pose a body in every frame, its root where the labels' mean places fall on the labels
    (Procrustes).
    """
    count = len(pose)
    frames = len(observed)
    upright = np.concatenate([np.zeros_like(pose[:, :1]), pose[:, 1:]], axis=1)
    places = places_of(rig, upright[:, None], np.zeros((count, 1, 3)))[:, 0]
    certain = np.maximum(posterior.sum(axis=2), 1e-3)
    mean = posterior @ places / certain[..., None]
    weights = np.isfinite(observed[None, ..., 0]) * certain[:, None]
    each = np.broadcast_to(mean[:, None], (count, frames, *mean.shape[1:]))
    matrix, shift = procrustes(each, np.broadcast_to(np.nan_to_num(observed), each.shape), weights)
    every = np.repeat(upright[:, None], frames, axis=1)
    every[:, :, 0] = rotvec_from_matrix(matrix)
    return every, shift + matrix @ rig.rest_joints[0] - rig.rest_joints[0]


def _directions() -> Float[np.ndarray, "D 3"]:
    """Rotation vectors of a body: the 24 rotations of a cube, and those between the upright ones of
    every axis.
    """
    signed = [
        np.diag(signs)[list(order)] for order in _ORDERS for signs in product((1.0, -1.0), repeat=3)
    ]
    cube = np.array([matrix for matrix in signed if np.linalg.det(matrix) > 0])
    half = matrix_from_rotvec(np.array([0.0, np.pi / 4, 0.0]))
    return rotvec_from_matrix(np.concatenate([cube, cube @ half]))


_ORDERS = ((0, 1, 2), (0, 2, 1), (1, 0, 2), (1, 2, 0), (2, 0, 1), (2, 1, 0))


def _widest(observed: Float[np.ndarray, "F M 3"], count: int) -> Int[np.ndarray, " f"]:
    """The frames in which the markers reach furthest from their middle."""
    away = np.linalg.norm(observed - np.nanmedian(observed, axis=1, keepdims=True), axis=2)
    seen = np.isfinite(away)
    return np.argsort(
        -np.nan_to_num(away).sum(axis=1) / np.maximum(seen.sum(axis=1), 1), kind="stable"
    )[:count]


def _that_differ(bodies: Bodies, skin: Skin, settings: DiscoverSettings) -> Bodies:
    """The cheapest bodies, none of which puts the labels where a cheaper one does."""
    places = bodies.posterior @ skin.points

    def alike(a: int, b: int) -> bool:
        return bool(np.linalg.norm(places[a] - places[b], axis=1).mean() <= settings.distinct)

    return bodies.of(distinct_rows(bodies.cost, settings.kept, alike))
