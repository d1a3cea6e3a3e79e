"""Pose and place of a scanned person from nothing: many poses from all sides, the best refined,
limbs tried anew.

Coarse to fine: a few hundred points against every pose of a bank in every turn, all scaled to the
scan's size; of the best each limb alone in the ways of all poses of the bank; Gauss-Newton; limbs
and Gauss-Newton again.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float
from scipy.spatial import cKDTree

from habitus.fit.registration.guesses import FAR, UNSEEN, Guesser, both
from habitus.fit.registration.model_stage import Cloud, ModelFitter, ModelState, ModelStep
from habitus.rotations import matrix_from_rotvec, rotvec_from_matrix

HEADINGS = 12
LOOKED_AT = 160
LOOKED_BACK, SAME_POSE, SAME_TURN = 200, 2, 3
"""Looks whose model is held against the scan, too; of one pose, and in one turn, so many go on at
most.
"""
KEPT = 12
REFINED = 3
POOR, WIDER = 0.07, 2
"""A start with more against it (m) than people have, and how many times as many looks go on when
there is no better.
"""
WHOLE_LIMBS = 4
HOPELESS = 1.4
"""So much worse than the best a rough fit is given up."""
ROUGH = (
    ModelStep(3, 500, 0.3, 0.03, 1.0, 1, 1.0),
    ModelStep(4, 700, 0.2, 0.02, 0.5, 3, 0.5),
)
FINER = (ModelStep(4, 1000, 0.12, 0.01, 0.3, 6, 0.3), ModelStep(3, 1500, 0.08, 0.01, 0.2, 10, 0.5))


@dataclass(frozen=True, eq=False)
class Candidate:
    """A state of one scan that was turned by ``turn`` (3, 3), and what speaks against it (m)."""

    state: ModelState
    turn: Float[np.ndarray, "3 3"]
    misfit: float


def find_start(
    guesser: Guesser, cloud: Cloud, turns: Float[np.ndarray, "U 3 3"]
) -> list[Candidate]:
    """The best few states of a scan under the turns that bring it upright, the best first.

    The best is tried facing the other way, too: with level arms front and back look alike. Where
    none is what people's are, more poses and turns are tried.
    """
    found = _search(guesser, cloud, turns, 1)
    found = sorted([*found, _about_face(guesser, cloud, found[0])], key=lambda one: one.misfit)
    if found[0].misfit > POOR:
        found = sorted(found + _search(guesser, cloud, turns, WIDER), key=lambda one: one.misfit)
    return found


def _search(guesser: Guesser, cloud: Cloud, turns: np.ndarray, wide: int) -> list[Candidate]:
    """The same with ``wide`` times as many looks."""
    looked = [_with_limbs(guesser, cloud, one) for one in _look(guesser, cloud, turns, wide)]
    rough = [_refined(guesser, cloud, one, ROUGH) for one in looked]
    rough = _apart(sorted(rough, key=lambda one: one.misfit))[:REFINED]
    rough = [one for one in rough if one.misfit < HOPELESS * rough[0].misfit]
    return sorted((_finely(guesser, cloud, one) for one in rough), key=lambda one: one.misfit)


def _finely(guesser: Guesser, cloud: Cloud, one: Candidate) -> Candidate:
    """Limbs tried anew, and more steps, twice."""
    scene = guesser.scene(_turned(cloud, one.turn))
    for _ in range(2):
        one = _refined(guesser, cloud, replace(one, state=scene.limbs(one.state)), FINER)
    return one


def _about_face(guesser: Guesser, cloud: Cloud, one: Candidate) -> Candidate:
    """A person upright in the same place who looks the other way; shape and pose are sought from
    the mean.
    """
    ahead = matrix_from_rotvec(one.state.pose[0, 0])[:, 2]
    pose = np.concatenate([np.zeros((1, 3)), guesser.fitter.prior.mean.reshape(-1, 3)])
    pose[0, 1] = np.arctan2(ahead[0], ahead[2]) + np.pi
    state = ModelState(np.zeros_like(one.state.betas), pose[None], one.state.trans)
    scene = guesser.scene(_turned(cloud, one.turn))
    return _finely(
        guesser, cloud, _refined(guesser, cloud, replace(one, state=scene.limbs(state)), ROUGH)
    )


def _look(guesser: Guesser, cloud: Cloud, turns: np.ndarray, wide: int) -> list[Candidate]:
    """Every pose in every turn, by the mean distance of some points of the scan from it; the best
    of them.
    """
    fitter = guesser.fitter
    bank = guesser.bank
    few = cloud.first(LOOKED_AT)
    middle, size = _size(cloud.first(2000).points)
    yaw = np.linspace(0.0, 2.0 * np.pi, HEADINGS, endpoint=False)
    spin = matrix_from_rotvec(yaw[:, None] * np.array([0.0, 1.0, 0.0]))
    all_turns = (spin[None] @ turns[:, None]).reshape(-1, 3, 3)  # scan -> body's own heading
    points = np.einsum("tij,pj->tpi", all_turns, few.points - middle)
    normals = np.einsum("tij,pj->tpi", all_turns, few.normals)
    surfaces = guesser.whole.placed(np.zeros(fitter.body.num_betas), bank, np.zeros(3))
    scores = np.empty((len(bank), len(all_turns)))
    every = cloud.first(2000)
    scan = cKDTree(both(every.points - middle, every.normals))
    for b, surface in enumerate(surfaces):
        centre, own = _size(surface[:, :3])
        scale = np.clip(own / size, 0.6, 1.7)
        tree = cKDTree(surface - np.pad(centre, (0, 3)))
        away = tree.query(both(scale * points, normals), distance_upper_bound=2 * FAR)[0]
        scores[b] = np.minimum(away, 2 * FAR).mean(1)
    best = np.unravel_index(np.argsort(scores, axis=None)[: wide * LOOKED_BACK], scores.shape)
    for b, t in zip(*best, strict=True):
        centre, own = _size(surfaces[b, :, :3])
        model = (surfaces[b, ::4] - np.pad(centre, (0, 3))).reshape(-1, 2, 3) @ all_turns[t]
        model[:, 0] /= np.clip(own / size, 0.6, 1.7)
        back = scan.query(model.reshape(-1, 6), distance_upper_bound=2 * FAR)[0]
        scores[b, t] += UNSEEN * np.minimum(back, 2 * FAR).mean()
    found = []
    seen = dict[tuple[str, int], int]()
    for b, t in sorted(zip(*best, strict=True), key=lambda pair: scores[pair]):
        counts = seen.get(("pose", b), 0), seen.get(("turn", t), 0)
        if (
            counts[0] < wide * SAME_POSE
            and counts[1] < wide * SAME_TURN
            and len(found) < wide * KEPT
        ):
            seen["pose", b], seen["turn", t] = counts[0] + 1, counts[1] + 1
            found.append(
                _placed(
                    fitter,
                    bank[b],
                    surfaces[b, :, :3],
                    turns[t // HEADINGS],
                    spin[t % HEADINGS],
                    middle,
                )
            )
    return found


def _placed(
    fitter: ModelFitter,
    pose: np.ndarray,
    surface: np.ndarray,
    turn: np.ndarray,
    spin: np.ndarray,
    middle: np.ndarray,
) -> Candidate:
    """A pose of the bank, headed as the scan is when ``turn`` has brought it upright, its middle on
    the scan's.
    """
    heading = spin.T @ matrix_from_rotvec(pose[0])
    pose = np.concatenate([rotvec_from_matrix(heading)[None], pose[1:]])
    root = fitter.body.joint_template[0]
    centre = spin.T @ (_size(surface)[0] - root) + root
    state = ModelState(np.zeros(fitter.body.num_betas), pose[None], (turn @ middle - centre)[None])
    return Candidate(state, turn, np.inf)


def _with_limbs(guesser: Guesser, cloud: Cloud, one: Candidate) -> Candidate:
    """Arms and legs tried anew before any step: a step would bend what is near towards an arm that
    is elsewhere.
    """
    scene = guesser.scene(_turned(cloud, one.turn))
    return replace(one, state=scene.limbs(one.state, guesser.limbs[:WHOLE_LIMBS]))


def _refined(
    guesser: Guesser, cloud: Cloud, one: Candidate, schedule: Sequence[ModelStep]
) -> Candidate:
    """Some steps from there; roughly at first, the pose held near where it begins."""
    turned = _turned(cloud, one.turn)
    fitter = guesser.fitter
    state = one.state
    if schedule is ROUGH:
        own = replace(fitter, prior=replace(fitter.prior, mean=state.pose[0, 1:].ravel()))
        state = own.fit(state, [turned], ROUGH[:1])
        schedule = ROUGH[1:]
    state = fitter.fit(state, [turned], schedule)
    return Candidate(state, one.turn, guesser.scene(turned).misfit(state))


def _apart(found: list[Candidate]) -> list[Candidate]:
    """Those that are not nearly the same as a better one."""
    kept: list[Candidate] = []
    for one in found:
        same = any(
            np.array_equal(one.turn, other.turn)
            and np.abs(one.state.pose - other.state.pose).max() < 0.15
            for other in kept
        )
        if not same:
            kept.append(one)
    return kept


def _turned(cloud: Cloud, turn: np.ndarray) -> Cloud:
    return Cloud(cloud.points @ turn.T, cloud.normals @ turn.T)


def _size(points: np.ndarray) -> tuple[np.ndarray, float]:
    """Middle and size: mean, and root mean square distance from it."""
    middle = points.mean(0)
    return middle, float(np.sqrt(((points - middle) ** 2).sum(1).mean()))
