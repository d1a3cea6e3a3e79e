"""Hands and feet turned the wrong way: from where a fit has them each is tried in other ways, and
the best stays.

A hand is a small part of a scan, and a palm looks much like its back: no step of a whole fit turns
it over.

A limb that was lost, looked for again: where a piece of the scan lies off the surface, the limbs
near it are tried.

What is found counts only where it leaves less of the scan off a quick surface, the model with an
offset of few steps, so that nothing more is spent on what no limb explains: spread fingers, of
which the default body knows nothing.
"""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from jaxtyping import Float

from habitus.body.prior import PosePrior
from habitus.fit.points.correspondences import TURN, nearest
from habitus.fit.points.scan import Cloud
from habitus.fit.points.scan_fitting import EVERYTHING, ModelFitter, ModelStep, fit_with_offsets
from habitus.fit.points.scan_result import lost_piece, lost_share
from habitus.fit.points.scan_start import Guesser, Limb
from habitus.fit.points.state import ModelState
from habitus.rotations import matrix_from_rotvec, rotvec_from_matrix

REACH = 0.13
"""Metres from the middle of a hand or foot within which points are looked at."""
FEWEST = 40
MOST = 500
OTHERS = 500
FAR = 0.03
LOOSE, FIRM = 0.6, 0.03
"""Radians (sd): how far wrists, ankles and other joints may go from where they begin."""
_WAYS = np.array(
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
TRIES = {
    "left_wrist": _WAYS,
    "right_wrist": _WAYS,
    "left_ankle": 0.4 * _WAYS[:7],
    "right_ankle": 0.4 * _WAYS[:7],
}
"""Turns of hands and feet in their own axes (of a body in the T-pose), rad: x is about the forearm.
"""
_TWISTS = np.array([[0, 0, 0], [0.8, 0, 0], [-0.8, 0, 0], [1.6, 0, 0], [-1.6, 0, 0]])
ARMS = {f"{side}_{joint}": _TWISTS for joint in ("shoulder", "elbow") for side in ("left", "right")}
"""Turns of arms about themselves: the skin of an arm is much the same all around it."""
STEPS = (
    ModelStep(5, MOST + OTHERS, 0.05, 0.005, 0.2, 0),
    ModelStep(3, MOST + OTHERS, 0.02, 0.005, 0.1, 0),
)
PER_NAT = 0.0003
"""Metres of mean distance of a hand's points that one unit of the prior's energy is worth."""


def with_extremities(
    fitter: ModelFitter, state: ModelState, cloud: Cloud, tries: Mapping[str, np.ndarray] = TRIES
) -> ModelState:
    """The state of one scan with each hand and foot (or ``ARMS``), of which it shows enough, turned
    the best way.
    """
    names = fitter.body.joint_names
    for name, ways in tries.items():
        if name not in names:
            continue
        joint = names.index(name)
        hand = fitter.vertices(state)[_hand(fitter, joint)]
        reach = max(REACH, float(np.linalg.norm(hand - hand.mean(0), axis=1).max()))
        near = np.linalg.norm(cloud.points - hand.mean(0), axis=1) < reach
        if near.sum() < FEWEST:
            continue
        there = np.flatnonzero(near)[:MOST]
        rows = np.concatenate([there, np.arange(min(OTHERS, len(cloud.points)))])
        few = Cloud(cloud.points[rows], cloud.normals[rows])
        looked = Cloud(cloud.points[there], cloud.normals[there])
        held = replace(fitter, prior=_held(state, names, joint))
        tried = [held.fit(_turned(state, joint, turn), [few], STEPS[:1]) for turn in ways]
        tried = sorted(tried, key=lambda one: _misfit(fitter, one, looked))[:2]
        tried = [held.fit(one, [few], STEPS[1:]) for one in tried]
        state = min(tried, key=lambda one: _misfit(fitter, one, looked))
    return state


def _hand(fitter: ModelFitter, joint: int) -> np.ndarray:
    """Vertices that ride on a joint or on what hangs on it."""
    parents = fitter.body.parents
    mine = [joint]
    for joint, parent in enumerate(parents):
        if parent in mine:
            mine.append(joint)
    return fitter.body.skinning_weights[:, mine].sum(1) > 0.5


def _held(state: ModelState, names: tuple[str, ...], joint: int) -> PosePrior:
    """A prior that keeps all joints but one where they are."""
    spread = np.full((len(names), 3), FIRM)
    spread[joint] = LOOSE
    return PosePrior(names[1:], state.pose[0, 1:].ravel(), np.diag(spread[1:].ravel() ** 2))


def _turned(state: ModelState, joint: int, turn: Float[np.ndarray, " 3"]) -> ModelState:
    pose = state.pose.copy()
    pose[0, joint] = rotvec_from_matrix(
        matrix_from_rotvec(pose[0, joint]) @ matrix_from_rotvec(turn)
    )
    return replace(state, pose=pose)


def _misfit(fitter: ModelFitter, state: ModelState, hand: Cloud) -> float:
    """Mean capped distance (m) of a hand's points, directions counted, and what the prior says."""
    found = fitter.matched(state, 0, hand)
    apart = ((hand.points - found.place) ** 2).sum(1) + TURN**2 * 2.0 * (
        1.0 - np.clip(found.cosine, -1.0, 1.0)
    )
    off = fitter.prior.whitening @ (state.pose[0, 1:].ravel() - fitter.prior.mean)
    return float(np.minimum(np.sqrt(apart), FAR).mean() + PER_NAT * 0.5 * (off @ off))


WHOLE = 5
"""Arms, legs and head are the first of the guesser's limbs."""
NEAR = 0.1
"""Metres: a limb so much further from the lost piece than the nearest one is tried, too."""
QUICK = (ModelStep(2, 6000, 0.03, 0.004, 0.0, EVERYTHING),)
LOOKED_AT = 20_000
LESS = 0.7
"""Of what is off the surface so much may be left for a limb to count as found."""


def away_from(
    guesser: Guesser, cloud: Cloud, surface: Float[np.ndarray, "V 3"]
) -> Float[np.ndarray, " N"]:
    """How far (m) each point of a scan is from a surface."""
    place = nearest(guesser.fitter.topology, surface, cloud.points, cloud.normals).place
    return np.linalg.norm(cloud.points - place, axis=1)


def found_limbs(
    guesser: Guesser,
    state: ModelState,
    cloud: Cloud,
    surface: Float[np.ndarray, "V 3"],
    schedule: tuple[ModelStep, ...],
) -> ModelState | None:
    """The state of one scan with the limbs near its lost piece placed anew; None where that is no
    better.
    """
    few = cloud.first(LOOKED_AT)
    _, place = lost_piece(few.points, away_from(guesser, few, surface))
    tried = state
    for limb in limbs_near(guesser, surface, place):
        tried = _anew(guesser, tried, cloud, limb, schedule)
    before, after = (_quickly_lost(guesser, one, few) for one in (state, tried))
    return tried if after < LESS * before else None


def limbs_near(
    guesser: Guesser, surface: Float[np.ndarray, "V 3"], place: Float[np.ndarray, " 3"]
) -> list[Limb]:
    """The arm, leg or head nearest a place (m), and those hardly further off."""
    weights = guesser.fitter.body.skinning_weights
    limbs = guesser.limbs[:WHOLE]
    mine = [weights[:, limb.joints].sum(1) > 0.5 for limb in limbs]
    away = np.array([np.linalg.norm(surface[rows] - place, axis=1).min() for rows in mine])
    return [limb for limb, far in zip(limbs, away, strict=True) if far <= away.min() + NEAR]


def _anew(
    guesser: Guesser, state: ModelState, cloud: Cloud, limb: Limb, schedule: tuple[ModelStep, ...]
) -> ModelState:
    """A whole limb and its parts in the ways of the bank, then turned about itself, then hand or
    foot.
    """
    fitter = guesser.fitter
    names = guesser.fitter.body.joint_names
    parts = [one for one in guesser.limbs if np.isin(one.joints, limb.joints).all()]
    state = fitter.fit(guesser.scene(cloud).limbs(state, parts), [cloud], schedule)
    for tries in (ARMS, TRIES):
        own = {
            name: ways
            for name, ways in tries.items()
            if name in names and names.index(name) in limb.joints
        }
        state = with_extremities(fitter, state, cloud, own)
    return state


def _quickly_lost(guesser: Guesser, state: ModelState, cloud: Cloud) -> float:
    """The share of a scan that lies together off the model and a quick offset."""
    _, (surface,) = fit_with_offsets(guesser.fitter, state, [cloud], QUICK)
    return lost_share(cloud.points, away_from(guesser, cloud, surface))
