"""Guesses at a scanned person's pose, many at a time: some triangles of the body against some
points of the scan.

Pose and place of a scanned person from nothing: many poses from all sides, the best refined,
limbs tried anew.

Coarse to fine: a few hundred points against every pose of a bank in every turn, all scaled to the
scan's size; of the best each limb alone in the ways of all poses of the bank; Gauss-Newton; limbs
and Gauss-Newton again.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import cKDTree

from habitus.body.model import BodyModel
from habitus.body.prepared import PreparedBody
from habitus.body.prior import PosePrior
from habitus.body.skinning import descends
from habitus.fit.markers.start import PLAIN_POSES, plain_pose
from habitus.fit.points.correspondences import TURN
from habitus.fit.points.scan import Cloud
from habitus.fit.points.scan_fitting import ModelFitter, ModelStep
from habitus.fit.points.state import ModelState
from habitus.rotations import matrix_from_rotvec, rotvec_from_matrix

DRAWN = 60
"""Poses of the bank that are drawn from the prior, and how far they go from its mean, in standard
deviations.
"""
SPREAD = 0.8
NEAR = 0.025
"""Metres from the rest of the body from which on a point may be a limb's."""
SCAN_POINTS = 4000
COMPARED = 300
TRIANGLES = 1000
FAR = 0.12
"""Metres: what is further away is no worse."""
UNSEEN = 0.5
"""What a point of the model without a scan counts against a point of the scan without a model."""
PER_NAT = 0.0005
"""Metres of mean distance that one unit of the prior's energy is worth."""
SCAN_POSES: tuple[dict[str, tuple[float, float, float]], ...] = (
    {"shoulder": (0.0, 0.0, -0.8)},
    {"shoulder": (0.0, -0.2, 1.2)},
    {"shoulder": (0.0, -1.4, 0.0)},
    {"shoulder": (0.0, -0.3, -0.9), "elbow": (0.0, -1.6, 0.0)},
    {"shoulder": (0.0, 0.0, -0.9), "hip": (-0.6, 0.0, 0.3), "knee": (1.0, 0.0, 0.0)},
    {"shoulder": (0.0, 0.0, -0.2), "elbow": (0.0, -0.3, 1.4)},
)
LIMBS = (
    ("left_collar", "left_shoulder"),
    ("right_collar", "right_shoulder"),
    ("left_hip",),
    ("right_hip",),
    ("neck",),
    ("left_elbow",),
    ("right_elbow",),
    ("left_knee",),
    ("right_knee",),
    ("left_wrist",),
    ("right_wrist",),
)


def pose_bank(prior: PosePrior, joint_names: tuple[str, ...]) -> Float[np.ndarray, "P J 3"]:
    """Poses to begin with; the root is at rest."""
    plain = [plain_pose(joint_names, angles) for angles in (*PLAIN_POSES, *SCAN_POSES)]
    rng = np.random.default_rng(0)
    root = np.linalg.cholesky(prior.covariance)
    drawn = prior.mean + SPREAD * rng.normal(size=(DRAWN, len(prior.mean))) @ root.T
    drawn = np.concatenate([prior.mean[None], drawn]).reshape(-1, len(joint_names) - 1, 3)
    return np.concatenate([np.array(plain), np.pad(drawn, ((0, 0), (1, 0), (0, 0)))])


@dataclass(frozen=True, eq=False)
class Sample:
    """Some triangles of a body, made ready to be placed in any shape and pose."""

    prepared: PreparedBody
    corner: Int[np.ndarray, "F 3"]

    @staticmethod
    def of(body: BodyModel, faces: Int[np.ndarray, "F 3"]) -> "Sample":
        """Those triangles."""
        used, corner = np.unique(faces, return_inverse=True)
        return Sample(body.prepare(np.zeros(body.num_betas), used), corner.reshape(-1, 3))

    def placed(
        self, betas: np.ndarray, pose: np.ndarray, trans: np.ndarray
    ) -> Float[np.ndarray, "T F 6"]:
        """Middles and directions in T poses of one shape."""
        joints = self.prepared.model._in(self.prepared.kind).rest_joints(betas)
        vertices = np.asarray(
            replace(self.prepared, coefficients=betas, rest_joints=joints)(pose, trans).vertices
        )
        a, b, c = np.moveaxis(vertices[:, self.corner], 2, 0)
        normal = np.cross(b - a, c - a)
        normal /= np.maximum(np.linalg.norm(normal, axis=-1, keepdims=True), 1e-12)
        return np.concatenate([(a + b + c) / 3.0, TURN * normal], -1)


@dataclass(frozen=True, eq=False)
class Limb:
    """The joints of a limb; the triangles that ride on them, and those that do not."""

    joints: Int[np.ndarray, " j"]
    moving: Sample
    still: Sample


@dataclass(frozen=True, eq=False)
class Guesser:
    """A body made ready for guesses: some triangles of all of it, and of each limb."""

    fitter: ModelFitter
    whole: Sample
    limbs: tuple[Limb, ...]
    bank: Float[np.ndarray, "P J 3"]

    @staticmethod
    def of(fitter: ModelFitter) -> "Guesser":
        """To be made once a body."""
        body = fitter.body
        faces = fitter.topology.faces[np.isin(fitter.topology.faces, fitter.topology.whole).all(1)]
        faces = faces[:: max(1, len(faces) // TRIANGLES)]
        names = body.joint_names
        below = descends(body.parents) > 0
        part = np.take_along_axis(body.skinning_index, body.skinning_value.argmax(1)[:, None], 1)[
            faces[:, 0], 0
        ]
        limbs = []
        for limb in LIMBS:
            joints = np.flatnonzero(below[[names.index(j) for j in limb if j in names]].any(0))
            mine = np.isin(part, joints)
            if mine.any() and not mine.all():
                limbs.append(
                    Limb(joints, Sample.of(body, faces[mine]), Sample.of(body, faces[~mine]))
                )
        return Guesser(fitter, Sample.of(body, faces), tuple(limbs), pose_bank(fitter.prior, names))

    def scene(self, cloud: Cloud) -> "Scene":
        """A scan that stands upright, to guess at."""
        some = cloud.first(SCAN_POINTS)
        scan = cKDTree(both(some.points, some.normals))
        return Scene(self, scan.data[:COMPARED], scan)


@dataclass(frozen=True, eq=False)
class Scene:
    """A scan and a body, to be held against each other."""

    guesser: Guesser
    few: Float[np.ndarray, "P 6"]
    scan: cKDTree

    def misfit(self, state: ModelState) -> float:
        """What speaks against a state: mean capped distance (m) of scan from model and of model
        from scan, and the prior.
        """
        model = self.guesser.whole.placed(state.betas, state.pose, state.trans[0])
        back = self._from_scan(model[0]).mean(keepdims=True)
        return float(self._cost(_distances(self.few, model), back, state.betas, state.pose)[0])

    def _from_scan(self, model: Float[np.ndarray, "*batch 6"]) -> Float[np.ndarray, "*batch"]:
        """Distances of the model's places and directions from the scan's, `FAR` at most."""
        return np.minimum(self.scan.query(model, distance_upper_bound=FAR)[0], FAR)

    def _cost(
        self, there: np.ndarray, back: np.ndarray, betas: np.ndarray, pose: np.ndarray
    ) -> np.ndarray:
        prior = self.guesser.fitter.prior
        off = pose[:, 1:].reshape(len(pose), -1) - prior.mean
        energy = 0.5 * (((off @ prior.precision) * off).sum(1) + betas @ betas)
        return np.minimum(there, FAR).mean(1) + UNSEEN * back + PER_NAT * FAR * energy

    def limbs(self, state: ModelState, which: Sequence[Limb] | None = None) -> ModelState:
        """Each limb, or each of ``which``, in turn in the ways of all poses of the bank; what fits
        best stays.
        """
        bank = self.guesser.bank
        every = self.scan.data
        for limb in self.guesser.limbs if which is None else which:
            tries = np.repeat(state.pose, len(bank) + 1, axis=0)
            tries[1:, limb.joints] = bank[:, limb.joints]
            rest = limb.still.placed(state.betas, state.pose, state.trans[0])
            moved = limb.moving.placed(state.betas, tries, state.trans[0])
            mine = np.flatnonzero(cKDTree(rest[0]).query(every, distance_upper_bound=FAR)[0] > NEAR)
            few = every[mine[:: max(1, len(mine) // COMPARED)]]
            there = (
                np.minimum(_distances(few, rest), _distances(few, moved))
                if len(few)
                else np.zeros((1, 1))
            )
            there = np.minimum(there, FAR).mean(1) * len(mine) / len(every)
            back = [self._from_scan(each).sum(1) for each in (rest, moved)]
            back = (back[0] + back[1]) / (rest.shape[1] + moved.shape[1])
            best = int(np.argmin(self._cost(there[:, None], back, state.betas, tries)))
            state = replace(state, pose=tries[best : best + 1])
        return state


def _distances(
    points: Float[np.ndarray, "P 6"], model: Float[np.ndarray, "T n 6"]
) -> Float[np.ndarray, "T P"]:
    """Of each point the distance from the nearest of the model's, in T poses."""
    centre = points.mean(0)
    points = (points - centre).astype(np.float32)
    model = (model - centre).astype(np.float32)
    off = (model**2).sum(2)[:, None] - 2.0 * (points @ model.swapaxes(1, 2))
    return np.sqrt(np.maximum(off.min(2) + (points**2).sum(1), 0.0)).astype(float)


def both(points: np.ndarray, normals: np.ndarray) -> Float[np.ndarray, "*batch 6"]:
    """Places and directions as one: how far apart two are, in metres and through `TURN`."""
    return np.concatenate([points, TURN * normals], -1)


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
