"""Hands, feet and limbs in a wrong local minimum: other poses of each are tried, the best stays.

A hand is a small part of a scan, and a palm looks much like its back: no step of a whole fit turns
it over. Where a piece of the scan lies off the registered surface, the limbs near it are searched
again as all poses of the bank have them. They count only where they leave less of the scan off a
quick surface, the model with skin offsets of few steps, so that no time is spent on what no limb
explains: spread fingers, which the default body does not have.
"""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from jaxtyping import Float

from habitus.body.prior import PosePrior
from habitus.body.state import BodyState
from habitus.fit.points.correspondences import NORMAL_DISTANCE, Topology, find_correspondences
from habitus.fit.points.scan import Cloud
from habitus.fit.points.scan_fitting import ScanFitter
from habitus.fit.points.scan_result import lost_piece, lost_share
from habitus.fit.points.scan_start import Guesser, Limb
from habitus.rotations import matrix_from_rotvec, rotvec_from_matrix

_TURNS = np.array(
    [
        [0, 0, 0],
        [1, 0, 0],
        [-1, 0, 0],
        [0, 0.8, 0],
        [0, -0.8, 0],
        [0, 0, 0.8],
        [0, 0, -0.8],
        [3, 0, 0],
    ]
)
EXTREMITIES = {
    "left_wrist": _TURNS,
    "right_wrist": _TURNS,
    "left_ankle": 0.4 * _TURNS[:7],
    "right_ankle": 0.4 * _TURNS[:7],
}
"""Turns of hands and feet in their own axes (of a body in the T-pose), rad: x is about the forearm.
"""
_TWISTS = np.array([[0, 0, 0], [0.8, 0, 0], [-0.8, 0, 0], [1.6, 0, 0], [-1.6, 0, 0]])
ARMS = {f"{side}_{joint}": _TWISTS for joint in ("shoulder", "elbow") for side in ("left", "right")}
"""Turns of arms about themselves: the skin of an arm is much the same all around it."""


def with_extremities(
    fitter: ScanFitter,
    state: BodyState,
    cloud: Cloud,
    tries: Mapping[str, np.ndarray] = EXTREMITIES,
) -> BodyState:
    """The state of one scan with each hand and foot (or ``ARMS``), of which it shows enough, turned
    the best way.
    """
    settings = fitter.settings.limbs
    names = fitter.body.joint_names
    for name, turns in tries.items():
        if name not in names:
            continue
        joint = names.index(name)
        vertices = fitter.vertices(state)[_hand(fitter, joint)]
        radius = max(
            settings.radius, float(np.linalg.norm(vertices - vertices.mean(0), axis=1).max())
        )
        near = np.linalg.norm(cloud.points - vertices.mean(0), axis=1) < radius
        if near.sum() < settings.min_points:
            continue
        there = np.flatnonzero(near)[: settings.max_points]
        rows = np.concatenate([there, np.arange(min(settings.other_points, len(cloud.points)))])
        few = Cloud(cloud.points[rows], cloud.normals[rows])
        hand = Cloud(cloud.points[there], cloud.normals[there])
        held = replace(fitter, prior=_held(fitter, state, joint))
        first, *rest = settings.stages
        tried = [held.fit(_turned(state, joint, turn), [few], [first]) for turn in turns]
        tried = sorted(tried, key=lambda one: _misfit(fitter, one, hand))[:2]
        tried = [held.fit(one, [few], rest) for one in tried]
        state = min(tried, key=lambda one: _misfit(fitter, one, hand))
    return state


def _hand(fitter: ScanFitter, joint: int) -> np.ndarray:
    """Vertices that ride on a joint or on what hangs on it."""
    parents = fitter.body.parents
    mine = [joint]
    for joint, parent in enumerate(parents):
        if parent in mine:
            mine.append(joint)
    return fitter.body.skinning_weights[:, mine].sum(1) > 0.5


def _held(fitter: ScanFitter, state: BodyState, joint: int) -> PosePrior:
    """A prior that keeps all joints but one where they are."""
    names = fitter.body.joint_names
    spread = np.full((len(names), 3), fitter.settings.limbs.held_sd)
    spread[joint] = fitter.settings.limbs.free_sd
    return PosePrior(names[1:], state.pose[0, 1:].ravel(), np.diag(spread[1:].ravel() ** 2))


def _turned(state: BodyState, joint: int, turn: Float[np.ndarray, " 3"]) -> BodyState:
    pose = state.pose.copy()
    pose[0, joint] = rotvec_from_matrix(
        matrix_from_rotvec(pose[0, joint]) @ matrix_from_rotvec(turn)
    )
    return replace(state, pose=pose)


def _misfit(fitter: ScanFitter, state: BodyState, hand: Cloud) -> float:
    """Mean capped distance (m) of a hand's points, normals counted, and the pose prior."""
    settings = fitter.settings.limbs
    correspondences = fitter.matched(state, 0, hand)
    square = correspondences.distances(hand.points) ** 2
    square += NORMAL_DISTANCE**2 * 2.0 * (1.0 - np.clip(correspondences.cosine, -1.0, 1.0))
    deviation = fitter.prior.whitening @ (state.pose[0, 1:].ravel() - fitter.prior.mean)
    distance = np.minimum(np.sqrt(square), settings.max_distance).mean()
    return float(distance + settings.prior_distance * 0.5 * (deviation @ deviation))


def scan_distances(
    topology: Topology, surface: Float[np.ndarray, "V 3"], cloud: Cloud
) -> Float[np.ndarray, " N"]:
    """Distances (m) of a scan's points from a surface."""
    return find_correspondences(topology, surface, cloud.points, cloud.normals).distances(
        cloud.points
    )


def limbs_searched_again(
    guesser: Guesser,
    state: BodyState,
    cloud: Cloud,
    surface: Float[np.ndarray, "V 3"],
) -> BodyState | None:
    """The state of one scan with the limbs near its lost piece placed anew; None where that is no
    better.
    """
    settings = guesser.fitter.settings.limbs
    few = cloud.first(settings.checked_points)
    distances = scan_distances(guesser.fitter.topology, surface, few)
    _, place = lost_piece(few.points, distances, settings)
    tried = state
    for limb in limbs_near(guesser, surface, place):
        tried = _anew(guesser, tried, cloud, limb)
    before, after = (_quickly_lost(guesser, one, few) for one in (state, tried))
    return tried if after < settings.improvement * before else None


def limbs_near(
    guesser: Guesser, surface: Float[np.ndarray, "V 3"], place: Float[np.ndarray, " 3"]
) -> list[Limb]:
    """The arm, leg or head closest to a point (m), and those hardly further off."""
    settings = guesser.fitter.settings.limbs
    weights = guesser.fitter.body.skinning_weights
    limbs = guesser.limbs[: settings.whole_limbs]
    mine = [weights[:, limb.joints].sum(1) > 0.5 for limb in limbs]
    distances = np.array([np.linalg.norm(surface[rows] - place, axis=1).min() for rows in mine])
    most = distances.min() + settings.margin
    return [limb for limb, each in zip(limbs, distances, strict=True) if each <= most]


def _anew(guesser: Guesser, state: BodyState, cloud: Cloud, limb: Limb) -> BodyState:
    """A limb and its parts as the bank has them, then turned about itself, then hand or foot."""
    fitter = guesser.fitter
    names = guesser.fitter.body.joint_names
    parts = [
        limb_parts for limb_parts in guesser.limbs if np.isin(limb_parts.joints, limb.joints).all()
    ]
    state = fitter.fit(guesser.scene(cloud).limbs(state, parts), [cloud], fitter.settings.stages)
    for tries in (ARMS, EXTREMITIES):
        own = {
            name: turns
            for name, turns in tries.items()
            if name in names and names.index(name) in limb.joints
        }
        state = with_extremities(fitter, state, cloud, own)
    return state


def _quickly_lost(guesser: Guesser, state: BodyState, cloud: Cloud) -> float:
    """The share of a scan that lies together off the model and a quick offset."""
    fitter = guesser.fitter
    (surface,) = fitter.fit_with_offsets(state, [cloud], fitter.settings.limbs.quick).surfaces
    distances = scan_distances(fitter.topology, surface, cloud)
    return lost_share(cloud.points, distances, fitter.settings.limbs)
