"""Hands, feet and limbs in a wrong local minimum: other poses of each are tried, the best stays.

A hand is a small part of a scan, and a palm looks much like its back: no step of a whole fit turns
it over, or closes it to a fist. Where a piece of the scan lies off the registered surface, the
limbs near it are searched again as all poses of the bank have them. They count only where they
leave less of the scan off a quick surface, the model with skin offsets of few steps.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import KDTree

from habitus.body.hand_space import has_hands
from habitus.body.hands import HAND_JOINTS, HAND_POSES, SIDES, hand_pose
from habitus.body.model import BodyModel
from habitus.body.prior import PosePrior
from habitus.body.state import BodyState
from habitus.fit.points.correspondences import NORMAL_DISTANCE
from habitus.fit.points.scan import Cloud
from habitus.fit.points.scan_evidence import energy, lost_piece, lost_share
from habitus.fit.points.scan_fitting import ScanFitter
from habitus.fit.points.scan_stage import ScanStage
from habitus.fit.points.scan_start import Guesser, Limb
from habitus.fit.verdict import FEET, HANDS, part_of_joint
from habitus.parallel.workers import map_on_threads
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


HAND_TURNS = np.array([[0.0, 0.0], [0.0, 3.0], [3.0, 0.0]])
"""Turns of forearm and wrist about the forearm, rad, in which every one of `HAND_POSES` is tried: a
palm looks much like its back, and so does a forearm.
"""


def with_extremities(
    fitter: ScanFitter,
    state: BodyState,
    cloud: Cloud,
    tries: Mapping[str, np.ndarray] = EXTREMITIES,
) -> BodyState:
    """The state of one scan with each hand and foot (or ``ARMS``), of which it shows enough, turned
    the best way.
    """
    names = fitter.body.joint_names
    for name, turns in tries.items():
        if name not in names:
            continue
        joint = names.index(name)
        if (near := _near(fitter, state, joint, cloud)) is None:
            continue
        held = replace(fitter, prior=_held(fitter, state, joint))
        tried = [(held, _turned(state, joint, turn)) for turn in turns]
        stages = fitter.settings.limbs.stages
        state = _best(tried, near, stages, lambda one, hand: _misfit(fitter, one, hand))
    return state


def with_hands(fitter: ScanFitter, state: BodyState, cloud: Cloud) -> BodyState:
    """The state of one scan with each hand, of which it shows enough, as the best of `HAND_POSES`,
    palm or back up, has it; unchanged for a body without finger joints.

    Poses that twist the forearm further than people twist it (`LimbSettings.most_twisted`) are left
    out. A hand counts against its points in both directions: what of it stands out of the scan is
    as wrong as what of the scan it leaves. Its parts inside the scan are not: palms of fists are
    hidden.
    """
    if not has_hands(fitter.body):
        return state
    names = fitter.body.joint_names
    for side in SIDES:
        elbow, wrist = (names.index(f"{side}_{joint}") for joint in ("elbow", "wrist"))
        fingers = [names.index(f"{side}_{joint}") for joint in HAND_JOINTS]
        near = _near(fitter, state, wrist, cloud)
        if near is None:
            continue
        rows = _hand(fitter, wrist)
        starts = [state]
        for grip in HAND_POSES:
            for turns in HAND_TURNS:
                start = state
                for joint, turn in zip((elbow, wrist), turns, strict=True):
                    start = _turned(start, joint, np.array([turn, 0.0, 0.0]))
                for joint, rotation in hand_pose(fitter.body, grip, (side,)).items():
                    start.pose[0, names.index(joint)] = rotation
                twists = forearm_twists(fitter.body, fitter.prior, start.pose[0])
                if twists[names[elbow]] < fitter.settings.limbs.most_twisted:
                    starts.append(start)
        tried = [
            (replace(fitter, prior=_held(fitter, start, wrist, fingers)), start) for start in starts
        ]

        def misfit(one: BodyState, hand: Cloud, rows: np.ndarray = rows) -> float:
            return _misfit(fitter, one, hand) + _outside(fitter, one, hand, rows)

        first = map_on_threads(lambda one, near=near: misfit(one[1], near[0]), tried)
        kept = [tried[k] for k in np.argsort(first)[: fitter.settings.limbs.hands_refined]]
        state = _best(kept, near, fitter.settings.limbs.hand_stages, misfit)
    return state


def _near(
    fitter: ScanFitter, state: BodyState, joint: int, cloud: Cloud
) -> tuple[Cloud, Cloud] | None:
    """Points of a scan near the hand or foot of a joint, and these with some of all others; None
    where they are too few.
    """
    settings = fitter.settings.limbs
    vertices = fitter.vertices(state)[_hand(fitter, joint)]
    middle = vertices.mean(0)
    radius = max(settings.radius, float(np.linalg.norm(vertices - middle, axis=1).max()))
    near = np.linalg.norm(cloud.points - middle, axis=1) < radius
    if near.sum() < settings.min_points:
        return None
    there = np.flatnonzero(near)[: settings.max_points]
    rows = np.concatenate([there, np.arange(min(settings.other_points, len(cloud.points)))])
    hand, few = (Cloud(cloud.points[k], cloud.normals[k], cloud.signed) for k in (there, rows))
    return hand, few


def _best(
    starts: Sequence[tuple[ScanFitter, BodyState]],
    near: tuple[Cloud, Cloud],
    stages: Sequence[ScanStage],
    misfit: Callable[[BodyState, Cloud], float],
) -> BodyState:
    """The best state after all stages of those two that are best after the first one; each start
    with the fitter whose prior holds the other joints.
    """
    hand, few = near
    first, *rest = stages

    def ran(
        start: tuple[ScanFitter, BodyState], some: Sequence[ScanStage]
    ) -> tuple[float, ScanFitter, BodyState]:
        held, state = start
        state = held.fit(state, [few], some)
        return misfit(state, hand), held, state

    tried = map_on_threads(lambda start: ran(start, [first]), starts)
    tried.sort(key=lambda one: one[0])
    ended = map_on_threads(lambda one: ran(one[1:], rest), tried[:2])
    return min(ended, key=lambda one: one[0])[2]


def _hand(fitter: ScanFitter, joint: int) -> np.ndarray:
    """Vertices that ride on a joint or on what hangs on it."""
    parents = fitter.body.parents
    mine = [joint]
    for joint, parent in enumerate(parents):
        if parent in mine:
            mine.append(joint)
    return fitter.body.skinning_weights[:, mine].sum(1) > 0.5


def _held(
    fitter: ScanFitter, state: BodyState, joint: int, as_before: Sequence[int] = ()
) -> PosePrior:
    """A prior that keeps all joints but one where they are; those of ``as_before`` keep theirs."""
    names = fitter.body.joint_names
    spread = np.full((len(names), 3), fitter.settings.limbs.held_sd)
    spread[joint] = fitter.settings.limbs.free_sd
    mean = state.pose[0, 1:].ravel().copy()
    covariance = np.diag(spread[1:].ravel() ** 2)
    rows = (3 * (np.asarray(as_before, int)[:, None] - 1) + np.arange(3)).ravel()
    mean[rows] = fitter.prior.mean[rows]
    covariance[np.ix_(rows, rows)] = fitter.prior.covariance[np.ix_(rows, rows)]
    return PosePrior(names[1:], mean, covariance)


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


def _outside(fitter: ScanFitter, state: BodyState, hand: Cloud, rows: np.ndarray) -> float:
    """Mean capped distance (m) of a hand's vertices from its points; 0 inside the scan."""
    vertices = fitter.vertices(state)[rows]
    distance, nearest = KDTree(hand.points).query(vertices)
    before = ((vertices - hand.points[nearest]) * hand.normals[nearest]).sum(1) > 0.0
    return float((np.minimum(distance, fitter.settings.limbs.max_distance) * before).mean())


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
    distances = guesser.fitter.distances(surface, few)
    _, place = lost_piece(few.points, distances, settings)
    tried = state
    for limb in limbs_near(guesser, surface, place):
        tried = _anew(guesser, tried, cloud, limb)
    before, after = (_quickly_lost(guesser, one, few) for one in (state, tried))
    return tried if after < settings.improvement * before else None


def with_usual_joints(
    guesser: Guesser, state: BodyState, cloud: Cloud, stages: Sequence[ScanStage]
) -> BodyState:
    """The state of one scan, with arms, legs and head searched again if one of their joints is bent
    further than people bend it (`LimbSettings.unusual`) or a forearm is twisted further than people
    twist it (`LimbSettings.twisted`).

    The search begins at the state and at the prior's mean; a twisted forearm is also turned back by
    half a turn. The state of least energy after ``stages`` is kept. An arm that is turned by half a
    turn about itself reaches the scan by a displaced collar, and leaves too little of the scan off
    the surface for `limbs_searched_again`.
    """
    fitter = guesser.fitter
    settings = fitter.settings.limbs
    mean = np.concatenate([np.zeros((1, 3)), fitter.prior.mean.reshape(-1, 3)])

    def cost(one: BodyState) -> float:
        return quick_energy(fitter, one, [cloud])

    for limb in guesser.limbs[: settings.whole_limbs]:
        joints = np.asarray(limb.joints)
        given = fitter.body, fitter.prior, state.pose[0]
        bent = limb_joint_deviations(*given)[joints].max() > settings.unusual
        twisted = any(
            twist > settings.twisted
            for elbow, twist in forearm_twists(*given).items()
            if fitter.body.joint_names.index(elbow) in joints
        )
        if not bent and not twisted:
            continue
        reset = state.pose.copy()
        reset[0, joints] = mean[joints]
        tried = [
            _anew(guesser, start, cloud, limb) for start in (state, replace(state, pose=reset))
        ]
        if twisted:
            back = _turned_back(fitter.body, state, joints)
            back = _limb_turned(fitter, back, cloud, limb, EXTREMITIES)
            tried.append(with_hands(fitter, back, cloud))
        state = min((fitter.fit(one, [cloud], stages) for one in (state, *tried)), key=cost)
    return state


def quick_energy(fitter: ScanFitter, state: BodyState, clouds: Sequence[Cloud]) -> float:
    """The energy of states of all scans together (`scan_evidence.energy`), after a few steps with
    skin offsets from there, on some of the points.
    """
    settings = fitter.settings.limbs
    few = [cloud.first(settings.checked_points) for cloud in clouds]
    return energy(fitter, fitter.fit_with_offsets(state, few, settings.quick), few)


def limb_joint_deviations(
    body: BodyModel, prior: PosePrior, pose: Float[np.ndarray, "J 3"]
) -> Float[np.ndarray, " J"]:
    """How far each joint's rotation (rad) by itself is from the prior's mean, in standard
    deviations of that joint; 0 for the root and for hands and feet, whose rotations the prior
    hardly knows.
    """
    parts = part_of_joint(body.joint_names, body.parents)
    bent = np.append(0.0, prior.joint_deviations(pose))
    bent[[part in (HANDS, FEET) for part in parts]] = 0.0
    return bent


def forearm_twists(
    body: BodyModel, prior: PosePrior, pose: Float[np.ndarray, "J 3"]
) -> dict[str, float]:
    """How far each forearm, by the name of its elbow, and its hand together are twisted about the
    forearm: rotation vectors (rad) of elbow and wrist along the forearm at rest, from the prior's
    mean in its standard deviations.
    """
    off = pose[1:].ravel() - prior.mean
    twists = {}
    for elbow, wrist, along in _forearms(body):
        both = np.zeros((body.num_joints, 3))
        both[[elbow, wrist]] = along
        both = both[1:].ravel()
        deviation = abs(both @ off) / np.sqrt(both @ prior.covariance @ both)
        twists[body.joint_names[elbow]] = float(deviation)
    return twists


def _forearms(body: BodyModel) -> list[tuple[int, int, Float[np.ndarray, " 3"]]]:
    """Elbow and wrist of each forearm, and its direction at rest."""
    names = body.joint_names
    rest = body.rest_joints(np.zeros(body.num_betas))
    found = []
    for side in SIDES:
        pair = [f"{side}_elbow", f"{side}_wrist"]
        if set(pair) <= set(names):
            elbow, wrist = map(names.index, pair)
            along = rest[wrist] - rest[elbow]
            found.append((elbow, wrist, along / np.linalg.norm(along)))
    return found


def forearms_turned_back(fitter: ScanFitter, state: BodyState, cloud: Cloud) -> BodyState | None:
    """The state of one scan with forearms that are twisted beyond `LimbSettings.most_twisted`
    turned back by half a turn, and hands posed again; None where there are none.
    """
    body = fitter.body
    twists = forearm_twists(body, fitter.prior, state.pose[0])
    limit = fitter.settings.limbs.most_twisted
    joints = [body.joint_names.index(elbow) for elbow, twist in twists.items() if twist > limit]
    if not joints:
        return None
    return with_hands(fitter, _turned_back(body, state, np.array(joints)), cloud)


def _turned_back(body: BodyModel, state: BodyState, joints: Int[np.ndarray, " n"]) -> BodyState:
    """The state with forearms whose elbows are among some joints twisted by half a turn less, all
    of it in the elbow.
    """
    for elbow, wrist, along in _forearms(body):
        if elbow in joints:
            pose = state.pose.copy()
            hand, arm = along @ pose[0, wrist], along @ pose[0, elbow]
            pose[0, wrist] -= hand * along
            turn = hand - np.sign(hand + arm) * np.pi
            state = _turned(replace(state, pose=pose), elbow, turn * along)
    return state


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
    parts = [
        limb_parts for limb_parts in guesser.limbs if np.isin(limb_parts.joints, limb.joints).all()
    ]
    state = fitter.fit(guesser.scene(cloud).limbs(state, parts), [cloud], fitter.settings.stages)
    for tries in (ARMS, EXTREMITIES):
        state = _limb_turned(fitter, state, cloud, limb, tries)
    return with_hands(fitter, state, cloud)


def _limb_turned(
    fitter: ScanFitter, state: BodyState, cloud: Cloud, limb: Limb, tries: Mapping[str, np.ndarray]
) -> BodyState:
    """`with_extremities` of the joints of a limb alone."""
    names = fitter.body.joint_names
    own = {
        name: turns
        for name, turns in tries.items()
        if name in names and names.index(name) in limb.joints
    }
    return with_extremities(fitter, state, cloud, own)


def _quickly_lost(guesser: Guesser, state: BodyState, cloud: Cloud) -> float:
    """The share of a scan that lies together off the model and a quick offset."""
    fitter = guesser.fitter
    (surface,) = fitter.fit_with_offsets(state, [cloud], fitter.settings.limbs.quick).surfaces
    distances = fitter.distances(surface, cloud)
    return lost_share(cloud.points, distances, fitter.settings.limbs)
