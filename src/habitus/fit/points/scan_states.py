"""What is known of a scan as it is registered; states of several scans, of one body as those of
another, and surfaces at rest.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Float

from habitus.body.jacobians import posed_skeleton
from habitus.body.joint_layouts import LAYOUTS
from habitus.body.model import BodyModel
from habitus.body.prior import PosePrior
from habitus.body.state import BodyState
from habitus.fit.points.scan import Cloud, Scan
from habitus.fit.points.scan_start import Candidate
from habitus.fit.points.settings import SCANS, ScanSettings
from habitus.rotations import matrix_from_rotvec

SEARCH_BETAS = 24
"""The most betas of a search for a pose from nothing."""


@dataclass(frozen=True, eq=False)
class Start:
    """The best start of a scan, its axis that points up, and the misfit of the best other pose
    relative to it (None: there is none).
    """

    best: Candidate
    up: str
    rival: float | None


@dataclass(frozen=True, eq=False)
class Registered:
    """What is known of one scan: the scan upright and in metres, its oriented cloud, its start, and
    where the fit is: state, surface (m), status and costs; ``islands``: as `Cleaned` has them.
    """

    scan: Scan
    cloud: Cloud
    start: Start
    state: BodyState
    surface: Float[np.ndarray, "V 3"]
    person: bool
    islands: float = 0.0
    status: str = "no person"
    costs: dict[str, float] = field(default_factory=dict)


def simpler(body: BodyModel) -> BodyModel:
    """The body as a pose is sought with it: without finger joints and with its first
    `SEARCH_BETAS` betas only; itself where it has no more.
    """
    if {*LAYOUTS["smplh"].joint_names} <= {*body.joint_names}:
        body = body.with_joints("smpl")
    betas = max(SEARCH_BETAS, body.shape_features)
    return body.with_betas(betas) if body.num_betas > betas else body


def joined(states: Sequence[BodyState]) -> BodyState:
    """One state of several scans; the shape is the mean."""
    return BodyState(
        np.mean([state.betas for state in states], axis=0),
        np.concatenate([state.pose for state in states]),
        np.concatenate([state.trans for state in states]),
    )


def carried(
    body: BodyModel, other: BodyModel, state: BodyState, settings: ScanSettings = SCANS
) -> BodyState:
    """A state of one body as one of another of its topology: the same poses, and the most similar
    shape.
    """
    mean = np.zeros(other.num_betas)
    count = other.num_vertices
    difference = body.rest_vertices(state.betas) - other.rest_vertices(mean)
    slopes = np.asarray(other.shapedirs, float).reshape(3 * count, -1)
    slopes = np.concatenate([slopes, np.tile(np.eye(3), (count, 1))], 1)  # betas, then translation
    ridge = settings.similar_bodies**2 * np.concatenate([np.ones(other.num_betas), np.zeros(3)])
    solved = np.linalg.solve(slopes.T @ slopes + np.diag(ridge), slopes.T @ difference.ravel())
    betas = solved[:-3]
    first = body.rest_joints(state.betas)[0]
    second = other.rest_joints(betas)[0]
    shift = solved[-3:] - first + second
    moved = np.array([matrix_from_rotvec(pose[0]) @ shift for pose in state.pose])
    return BodyState(betas, state.pose, state.trans + first - second + moved)


def extended(body: BodyModel, other: BodyModel, prior: PosePrior, state: BodyState) -> BodyState:
    """A state of a body as one of the same with more joints, these at the mean of its prior, and
    more betas, these 0.
    """
    mean = np.concatenate([np.zeros((1, 3)), prior.mean.reshape(-1, 3)])
    pose = np.tile(mean, (len(state.pose), 1, 1))
    for k, name in enumerate(other.joint_names):
        if name in body.joint_names:
            pose[:, k] = state.pose[:, body.joint_names.index(name)]
    further = np.zeros(other.num_betas - len(state.betas))
    return replace(state, betas=np.append(state.betas, further), pose=pose)


def at_rest(
    body: BodyModel, state: BodyState, offset: Float[np.ndarray, "V 3"]
) -> Float[np.ndarray, "V 3"]:
    """The person at rest: the model's, with a posed surface's offset from the posed model turned
    back.
    """
    skeleton = posed_skeleton(body, body.rest_joints(state.betas), state.pose[0])
    turn = np.einsum(
        "vk,vkij->vij", body.skinning_value, skeleton.motions[body.skinning_index][..., :3]
    )
    return body.rest_vertices(state.betas) + np.linalg.solve(turn, offset[..., None])[..., 0]
