"""Guesses at a scanned person's pose, many at a time: some triangles of the body against some
points of the scan.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import cKDTree

from habitus.body.kinematics import descends
from habitus.body.model import BodyModel
from habitus.body.prepared import PreparedBody
from habitus.body.prior import PosePrior
from habitus.fit.markers.start import PLAIN_POSES, plain_pose
from habitus.fit.registration.model_stage import Cloud, ModelFitter, ModelState
from habitus.fit.registration.nearest import TURN

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
