"""Pose and translation of a scanned person from nothing: a multi-start search, coarse to fine.

Some hundred points against every pose of a bank in every heading, all scaled to the scan's size; of
the best, each limb alone as all poses of the bank have it; Gauss-Newton; limbs and Gauss-Newton
again. Where that leaves the scan unexplained, poses by the ends of its limbs (`limb_ends`) go the
same way, then more of the bank. The score of a candidate is its misfit, metres:

    mean |scan - model| + a mean |model - scan|
    + c d (1/2 |betas|^2 + 1/2 (theta - mean)^T P (theta - mean))

distances being those of correspondences (`correspondences.with_normals`), capped at d. In
`SearchSettings`, a is `model_share`, c `prior_share` and d `max_distance`; P is the precision of
the pose prior.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import KDTree

from habitus.body.model import BodyModel
from habitus.body.prepared import PreparedBody
from habitus.body.prior import PosePrior
from habitus.body.skinning import descends
from habitus.body.state import BodyState
from habitus.fit.markers.start import PLAIN_POSES, plain_pose
from habitus.fit.points.correspondences import NORMAL_DISTANCE, with_normals
from habitus.fit.points.limb_ends import EndSearch
from habitus.fit.points.scan import Cloud
from habitus.fit.points.scan_fitting import ScanFitter
from habitus.fit.points.scan_stage import ScanStage
from habitus.fit.points.settings import SCANS, SearchSettings
from habitus.parallel.workers import map_on_threads
from habitus.rotations import matrix_from_rotvec, rotvec_from_matrix

SCAN_POSES: tuple[dict[str, tuple[float, float, float]], ...] = (
    {"shoulder": (0.0, 0.0, -0.8)},
    {"shoulder": (0.0, -0.2, 1.2)},
    {"shoulder": (0.0, -1.4, 0.0)},
    {"shoulder": (0.0, -0.3, -0.9), "elbow": (0.0, -1.6, 0.0)},
    {"shoulder": (0.0, 0.0, -0.9), "hip": (-0.6, 0.0, 0.3), "knee": (1.0, 0.0, 0.0)},
    {"shoulder": (0.0, 0.0, -0.2), "elbow": (0.0, -0.3, 1.4)},
    {"shoulder": (0.9, -0.2, -0.9), "elbow": (0.0, -1.5, 0.0)},
    {"shoulder": (0.5, -0.5, -1.1), "elbow": (0.0, -1.4, 0.0)},
    {"shoulder": (-1.3, -0.3, 0.0), "elbow": (0.0, -2.0, 0.0)},
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


def pose_bank(
    prior: PosePrior, joint_names: tuple[str, ...], settings: SearchSettings = SCANS.search
) -> Float[np.ndarray, "P J 3"]:
    """Poses of candidates, plain ones and some drawn from the prior; the root is at rest."""
    plain = [plain_pose(joint_names, angles) for angles in (*PLAIN_POSES, *SCAN_POSES)]
    rng = np.random.default_rng(0)
    root = np.linalg.cholesky(prior.covariance)
    drawn = prior.mean + settings.drawn_spread * (
        rng.normal(size=(settings.drawn_poses, len(prior.mean))) @ root.T
    )
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
        return np.concatenate([(a + b + c) / 3.0, NORMAL_DISTANCE * normal], -1)


@dataclass(frozen=True, eq=False)
class Limb:
    """The joints of a limb; the triangles that ride on them, and those that do not."""

    joints: Int[np.ndarray, " j"]
    moving: Sample
    still: Sample


@dataclass(frozen=True, eq=False)
class Guesser:
    """A body prepared for the search: some triangles of all of it, and of each limb."""

    fitter: ScanFitter
    whole: Sample
    limbs: tuple[Limb, ...]
    bank: Float[np.ndarray, "P J 3"]

    @cached_property
    def ends(self) -> EndSearch | None:
        """The search by the ends of limbs; None for a body on which they are not found."""
        return EndSearch.of(self.fitter, self.bank)

    @staticmethod
    def of(fitter: ScanFitter) -> "Guesser":
        """To be made once a body."""
        settings = fitter.settings.search
        body = fitter.body
        faces = fitter.topology.faces[np.isin(fitter.topology.faces, fitter.topology.whole).all(1)]
        faces = faces[:: max(1, len(faces) // settings.triangles)]
        names = body.joint_names
        below = descends(body.parents) > 0
        part = np.take_along_axis(body.skinning_index, body.skinning_value.argmax(1)[:, None], 1)[
            faces[:, 0], 0
        ]

        def limb_of(limb: tuple[str, ...]) -> Limb | None:
            joints = np.flatnonzero(below[[names.index(j) for j in limb if j in names]].any(0))
            mine = np.isin(part, joints)
            if not mine.any() or mine.all():
                return None
            return Limb(joints, Sample.of(body, faces[mine]), Sample.of(body, faces[~mine]))

        whole = Sample.of(body, faces)
        limbs = tuple(limb for limb in map_on_threads(limb_of, LIMBS) if limb is not None)
        return Guesser(fitter, whole, limbs, pose_bank(fitter.prior, names, settings))

    def scene(self, cloud: Cloud) -> "Scene":
        """A scan that stands upright, to score candidates by."""
        some = cloud.first(self.settings.scan_points)
        scan = KDTree(with_normals(some.points, some.normals))
        return Scene(self, scan.data[: self.settings.compared_points], scan)

    @property
    def settings(self) -> SearchSettings:
        """Of the search."""
        return self.fitter.settings.search


@dataclass(frozen=True, eq=False)
class Scene:
    """A scan and a body, which scores candidates."""

    guesser: Guesser
    few: Float[np.ndarray, "P 6"]
    scan: KDTree

    def misfit(self, state: BodyState) -> float:
        """The misfit of a state: mean capped distance (m) of scan from model and of model from
        scan, and the priors.
        """
        model = self.guesser.whole.placed(state.betas, state.pose, state.trans[0])
        back = self._from_scan(model[0]).mean(keepdims=True)
        return float(self._cost(_distances(self.few, model), back, state.betas, state.pose)[0])

    def _from_scan(self, model: Float[np.ndarray, "*batch 6"]) -> Float[np.ndarray, "*batch"]:
        """Capped distances of the model's points from the scan's."""
        most = self.guesser.settings.max_distance
        return np.minimum(self.scan.query(model, distance_upper_bound=most)[0], most)

    def _cost(
        self, there: np.ndarray, back: np.ndarray, betas: np.ndarray, pose: np.ndarray
    ) -> np.ndarray:
        settings = self.guesser.settings
        prior = self.guesser.fitter.prior
        off = pose[:, 1:].reshape(len(pose), -1) - prior.mean
        energy = 0.5 * (((off @ self.guesser.fitter.precision) * off).sum(1) + betas @ betas)
        most = settings.max_distance
        there = np.minimum(there, most).mean(1)
        return there + settings.model_share * back + settings.prior_share * most * energy

    def limbs(self, state: BodyState, which: Sequence[Limb] | None = None) -> BodyState:
        """Each limb, or each of ``which``, in turn as all poses of the bank have it; the best
        stays.
        """
        settings = self.guesser.settings
        most = settings.max_distance
        bank = self.guesser.bank
        every = self.scan.data
        for limb in self.guesser.limbs if which is None else which:
            tries = np.repeat(state.pose, len(bank) + 1, axis=0)
            tries[1:, limb.joints] = bank[:, limb.joints]
            rest = limb.still.placed(state.betas, state.pose, state.trans[0])
            moved = limb.moving.placed(state.betas, tries, state.trans[0])
            mine = np.flatnonzero(
                KDTree(rest[0]).query(every, distance_upper_bound=most)[0] > settings.limb_distance
            )
            few = every[mine[:: max(1, len(mine) // settings.compared_points)]]
            there = (
                np.minimum(_distances(few, rest), _distances(few, moved))
                if len(few)
                else np.zeros((1, 1))
            )
            there = np.minimum(there, most).mean(1) * len(mine) / len(every)
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


@dataclass(frozen=True, eq=False)
class Candidate:
    """A state of one scan that was turned by ``turn`` (3, 3), and its misfit (m)."""

    state: BodyState
    turn: Float[np.ndarray, "3 3"]
    misfit: float


def find_start(
    guesser: Guesser, cloud: Cloud, turns: Float[np.ndarray, "U 3 3"]
) -> list[Candidate]:
    """The best few states of a scan under the turns that bring it upright, the best first.

    The best is tried facing the other way, too: with level arms front and back look alike. Where it
    is not near all of the scan, further poses are tried: by the ends of limbs, then more of the
    bank.
    """
    rough = _rough(guesser, cloud, _scored(guesser, cloud, turns, 1))
    first = partial(_about_face, guesser, cloud, rough[0])
    candidates = _best_first([first, *_refinements(guesser, cloud, rough)])
    for further in (_by_ends, _widely):
        if _is_found(guesser, cloud, candidates[0]):
            break
        rough = _rough(guesser, cloud, further(guesser, cloud, turns))
        candidates += _best_first(_refinements(guesser, cloud, rough))
        candidates.sort(key=lambda one: one.misfit)
    return candidates


def _is_found(guesser: Guesser, cloud: Cloud, candidate: Candidate) -> bool:
    """Whether the misfit of a candidate is small and no limb of the scan is far from it."""
    settings = guesser.settings
    if candidate.misfit > settings.max_misfit:
        return False
    turned = _turned(cloud, candidate.turn).first(settings.scan_points)
    distances = guesser.fitter.distances(guesser.fitter.vertices(candidate.state), turned)
    return bool((distances > settings.lost_distance).mean() <= settings.max_lost)


def _by_ends(guesser: Guesser, cloud: Cloud, turns: np.ndarray) -> list[Candidate]:
    """States found by the ends of head, hands and feet, each under the turn that brings its trunk
    closest to upright.
    """
    if guesser.ends is None:
        return []
    body = guesser.fitter.body
    candidates = []
    for state in guesser.ends.starts(cloud):
        up = matrix_from_rotvec(state.pose[0, 0])[:, 1]
        turn = turns[int(np.argmax(turns[:, 1] @ up))]
        pose = state.pose.copy()
        pose[0, 0] = rotvec_from_matrix(turn @ matrix_from_rotvec(pose[0, 0]))
        root = body.rest_joints(state.betas)[0]
        trans = turn @ (root + state.trans[0]) - root
        candidates.append(Candidate(replace(state, pose=pose, trans=trans[None]), turn, np.inf))
    return candidates


def _widely(guesser: Guesser, cloud: Cloud, turns: np.ndarray) -> list[Candidate]:
    """Every pose in every heading, with more of them kept."""
    return _scored(guesser, cloud, turns, guesser.settings.widening)


def _rough(guesser: Guesser, cloud: Cloud, candidates: Sequence[Candidate]) -> list[Candidate]:
    """The best few of some candidates after the rough stages, the best first."""
    settings = guesser.settings
    best = map_on_threads(partial(_with_limbs, guesser, cloud), candidates)
    rough = map_on_threads(partial(_roughly, guesser, cloud), best)
    rough = _distinct(sorted(rough, key=lambda candidate: candidate.misfit))[: settings.refined]
    return [
        candidate
        for candidate in rough
        if candidate.misfit < settings.max_misfit_ratio * rough[0].misfit
    ]


def _refinements(
    guesser: Guesser, cloud: Cloud, rough: Sequence[Candidate]
) -> list[Callable[[], Candidate]]:
    """The fine stages of each candidate, to be run."""
    return [partial(_finely, guesser, cloud, candidate) for candidate in rough]


def _best_first(searches: Sequence[Callable[[], Candidate]]) -> list[Candidate]:
    """The candidates that these searches find, run on threads."""
    found = map_on_threads(lambda search: search(), searches)
    return sorted(found, key=lambda candidate: candidate.misfit)


def _finely(guesser: Guesser, cloud: Cloud, candidate: Candidate) -> Candidate:
    """Limbs tried anew, and more steps, twice."""
    scene = guesser.scene(_turned(cloud, candidate.turn))
    for _ in range(2):
        candidate = replace(candidate, state=scene.limbs(candidate.state))
        candidate = _refined(guesser, cloud, candidate, guesser.settings.fine)
    return candidate


def _about_face(guesser: Guesser, cloud: Cloud, candidate: Candidate) -> Candidate:
    """A person upright in the same place who looks the other way; shape and pose are sought from
    the mean.
    """
    ahead = matrix_from_rotvec(candidate.state.pose[0, 0])[:, 2]
    pose = np.concatenate([np.zeros((1, 3)), guesser.fitter.prior.mean.reshape(-1, 3)])
    pose[0, 1] = np.arctan2(ahead[0], ahead[2]) + np.pi
    state = BodyState(np.zeros_like(candidate.state.betas), pose[None], candidate.state.trans)
    scene = guesser.scene(_turned(cloud, candidate.turn))
    candidate = _roughly(guesser, cloud, replace(candidate, state=scene.limbs(state)))
    return _finely(guesser, cloud, candidate)


def _scored(guesser: Guesser, cloud: Cloud, turns: np.ndarray, wide: int) -> list[Candidate]:
    """Every pose in every heading, by the mean distance of some points of the scan from it; the
    best of them.
    """
    settings = guesser.settings
    cap = 2.0 * settings.max_distance
    fitter = guesser.fitter
    bank = guesser.bank
    few = cloud.first(settings.scored_points)
    middle, size = _size(cloud.first(2000).points)
    yaw = np.linspace(0.0, 2.0 * np.pi, settings.headings, endpoint=False)
    spin = matrix_from_rotvec(yaw[:, None] * np.array([0.0, 1.0, 0.0]))
    all_turns = (spin[None] @ turns[:, None]).reshape(-1, 3, 3)  # scan -> body's own heading
    points = np.einsum("tij,pj->tpi", all_turns, few.points - middle)
    normals = np.einsum("tij,pj->tpi", all_turns, few.normals)
    surfaces = guesser.whole.placed(np.zeros(fitter.body.num_betas), bank, np.zeros(3))
    every = cloud.first(2000)
    scan = KDTree(with_normals(every.points - middle, every.normals))

    def scored_pose(surface: np.ndarray) -> np.ndarray:
        centre, own = _size(surface[:, :3])
        scale = np.clip(own / size, 0.6, 1.7)
        tree = KDTree(surface - np.pad(centre, (0, 3)))
        distance = tree.query(with_normals(scale * points, normals), distance_upper_bound=cap)[0]
        return np.minimum(distance, cap).mean(1)

    scores = np.array(map_on_threads(scored_pose, surfaces))
    best = np.unravel_index(np.argsort(scores, axis=None)[: wide * settings.checked], scores.shape)
    for b, t in zip(*best, strict=True):
        centre, own = _size(surfaces[b, :, :3])
        model = (surfaces[b, ::4] - np.pad(centre, (0, 3))).reshape(-1, 2, 3) @ all_turns[t]
        model[:, 0] /= np.clip(own / size, 0.6, 1.7)
        back = scan.query(model.reshape(-1, 6), distance_upper_bound=cap)[0]
        scores[b, t] += settings.model_share * np.minimum(back, cap).mean()
    scored = []
    seen = dict[tuple[str, int], int]()
    for b, t in sorted(zip(*best, strict=True), key=lambda pair: scores[pair]):
        counts = seen.get(("pose", b), 0), seen.get(("turn", t), 0)
        if (
            counts[0] < wide * settings.same_pose
            and counts[1] < wide * settings.same_heading
            and len(scored) < wide * settings.kept
        ):
            seen["pose", b], seen["turn", t] = counts[0] + 1, counts[1] + 1
            scored.append(
                _placed(
                    fitter,
                    bank[b],
                    surfaces[b, :, :3],
                    turns[t // settings.headings],
                    spin[t % settings.headings],
                    middle,
                )
            )
    return scored


def _placed(
    fitter: ScanFitter,
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
    state = BodyState(np.zeros(fitter.body.num_betas), pose[None], (turn @ middle - centre)[None])
    return Candidate(state, turn, np.inf)


def _with_limbs(guesser: Guesser, cloud: Cloud, candidate: Candidate) -> Candidate:
    """Arms and legs tried anew before any step: a step would bend what is near towards an arm that
    is elsewhere.
    """
    scene = guesser.scene(_turned(cloud, candidate.turn))
    return replace(
        candidate,
        state=scene.limbs(candidate.state, guesser.limbs[: guesser.settings.arms_and_legs]),
    )


def _roughly(guesser: Guesser, cloud: Cloud, candidate: Candidate) -> Candidate:
    """The rough stages; in the first the prior is about the pose of the candidate."""
    fitter = guesser.fitter
    first, *rest = guesser.settings.rough
    held = replace(fitter, prior=replace(fitter.prior, mean=candidate.state.pose[0, 1:].ravel()))
    state = held.fit(candidate.state, [_turned(cloud, candidate.turn)], [first])
    return _refined(guesser, cloud, replace(candidate, state=state), rest)


def _refined(
    guesser: Guesser, cloud: Cloud, candidate: Candidate, stages: Sequence[ScanStage]
) -> Candidate:
    """Some stages further."""
    turned = _turned(cloud, candidate.turn)
    state = guesser.fitter.fit(candidate.state, [turned], stages)
    return Candidate(state, candidate.turn, guesser.scene(turned).misfit(state))


def _distinct(candidates: list[Candidate]) -> list[Candidate]:
    """Those that are not nearly the same as a better one."""
    kept: list[Candidate] = []
    for candidate in candidates:
        same = any(
            np.array_equal(candidate.turn, other.turn)
            and np.abs(candidate.state.pose - other.state.pose).max() < 0.15
            for other in kept
        )
        if not same:
            kept.append(candidate)
    return kept


def _turned(cloud: Cloud, turn: np.ndarray) -> Cloud:
    return replace(cloud, points=cloud.points @ turn.T, normals=cloud.normals @ turn.T)


def _size(points: np.ndarray) -> tuple[np.ndarray, float]:
    """Middle and size: mean, and root mean square distance from it."""
    middle = points.mean(0)
    return middle, float(np.sqrt(((points - middle) ** 2).sum(1).mean()))
