"""Where a discovery begins: bodies in a few single frames, from plain poses, in many directions, of
two sizes.
"""

from itertools import product

import numpy as np
from jaxtyping import Float, Int

from habitus.body.model import BodyModel
from habitus.body.prior import PosePrior
from habitus.fit.discover.assign import Bodies, Known, Schedule, places_of, posed, settled
from habitus.fit.discover.skin import Skin
from habitus.fit.markers.start import PLAIN_POSES, plain_pose
from habitus.fit.search import best_of_tries, distinct_rows
from habitus.mesh.mirror import mirrored_joints
from habitus.observe.marker_prediction import MarkedBody
from habitus.rotations import matrix_from_rotvec, procrustes, rotvec_from_matrix

SINGLE: Schedule = (
    (0.15, 100.0),
    (0.12, 50.0),
    (0.12, 20.0),
    (0.12, 6.0),
    (0.09, 4.0),
    (0.07, 3.0),
    (0.06, 2.0),
)
_LOOKED_AT = 3  # frames: those in which the markers reach furthest
_APART = 0.04  # metres: bodies whose labels sit nearer than this on average are one
_KEPT = 8
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
) -> Bodies:
    """The cheapest bodies that differ, of single frames; each once more turned about (`turned`)."""
    directions = _directions()
    pose = np.array([plain_pose(body.joint_names, angles) for angles in _POSES]).repeat(
        len(directions), axis=0
    )
    pose[:, 0] = np.tile(directions, (len(_POSES), 1))
    around = np.median(places_of(rig, pose[:, None], np.zeros((len(pose), 1, 3)))[:, 0], axis=1)
    found = []
    for frame in _widest(observed):
        here = observed[frame : frame + 1]
        trans = np.nanmedian(here[0], axis=0) - around
        found.append(settled(rig, here, prior, pose[:, None], trans[:, None], SINGLE, known))
    fields = (
        np.concatenate([getattr(each, name) for each in found]) for name in Bodies.__annotations__
    )
    kept = _that_differ(Bodies(*fields), skin)
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
        for firmness in (20.0, 2.0):
            pose, trans, cost = posed(
                rig, observed, bodies.posterior, prior, pose, trans, firmness, sweeps=6
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


def _widest(observed: Float[np.ndarray, "F M 3"]) -> Int[np.ndarray, " f"]:
    """The frames in which the markers reach furthest from their middle."""
    away = np.linalg.norm(observed - np.nanmedian(observed, axis=1, keepdims=True), axis=2)
    seen = np.isfinite(away)
    return np.argsort(
        -np.nan_to_num(away).sum(axis=1) / np.maximum(seen.sum(axis=1), 1), kind="stable"
    )[:_LOOKED_AT]


def _that_differ(bodies: Bodies, skin: Skin) -> Bodies:
    """The cheapest bodies, none of which puts the labels where a cheaper one does."""
    places = bodies.posterior @ skin.points

    def alike(a: int, b: int) -> bool:
        return bool(np.linalg.norm(places[a] - places[b], axis=1).mean() <= _APART)

    return bodies.of(distinct_rows(bodies.cost, _KEPT, alike))
