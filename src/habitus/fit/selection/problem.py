"""What marker selection knows of a posed body: how markers and goal move with its state, to first
order (M 7).

M evaluates a set of markers by fits to it (eq. 12), some million of them. At the state that fits a
whole surface best, a fit to a few markers is a linear problem: with J the derivatives of markers by
the N numbers of the state, e what the body cannot explain of them, w their weight and L the priors'
precision, it is off by

    d = G sum w J^T e,        G = (sum w J^T J + L)^-1,

give or take what noise of variance 1/w and people drawn from the prior do to it, whose covariance
is G. `habitus.fit.selection.full` makes the fits themselves, to hold this against them.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from habitus.body.jacobians import surface_jacobian
from habitus.body.model import BodyModel
from habitus.body.prior import PosePrior
from habitus.errors import HabitusError
from habitus.fit.markers.settings import MoshWeights
from habitus.residuals.shape_stage import per_m2

GOALS = ("surface", "shape", "pose")
"""Errors that markers are chosen by: of the posed surface (eq. 13), of the person at rest, of the
posed joints.
"""
REGIONS: Mapping[str, tuple[str, ...]] = {
    "all": (),
    "legs": ("hip", "knee", "ankle", "foot"),
    "arms": ("collar", "shoulder", "elbow", "wrist", "hand"),
    "trunk": ("pelvis", "spine1", "spine2", "spine3", "collar"),
    "head": ("neck", "head"),
}
"""Parts of the body, by the names of joints without sides."""
NOISE = float(1.0 / np.sqrt(per_m2(MoshWeights().data)))
"""Metres, standard deviation of a marker: what MoSh's weight of the data says."""


@dataclass(frozen=True)
class SelectionSettings:
    """Settings of the choice of markers and of poses."""

    noise: float = NOISE
    """Metres, standard deviation of a marker in a fit to a set of markers."""
    slip: float = 0.005
    """Metres, standard deviation: how far skin carries a marker from where it sits, otherwise in
    every frame. Chosen by hand."""
    free: float = 1.0
    """Radians and metres, standard deviation: how freely the root turns and stands; large beside
    both."""
    min_distance: float = 0.015
    """Metres below which two places of candidates are one, and a place and its mirror image twins.
    """
    flesh: float = 0.004
    """Metres, standard deviation: how far the skin of held-out people is off any body model,"""
    flesh_reach: float = 0.08
    """and over what distance alike. Chosen by hand."""
    sample: int = 500
    """Vertices by which the best state of a held-out person is fitted: more change it by less than
    ``noise``."""
    min_ankle_offset: float = 0.06
    """Metres of the left ankle from the sagittal plane in poses that can be held."""


SELECTION = SelectionSettings()


@dataclass(frozen=True)
class Candidates:
    """Markers that may be chosen: labels and vertices (C,), and groups of them that are chosen
    together (pairs).
    """

    labels: tuple[str, ...]
    vertices: Int[np.ndarray, " C"]
    groups: tuple[tuple[int, ...], ...]

    def count(self, groups: Sequence[int]) -> int:
        """How many markers these groups are."""
        return sum(len(self.groups[k]) for k in groups)


@dataclass(frozen=True, eq=False)
class Linearised:
    """Z posed bodies, N numbers of state each, G groups of at most R / 3 markers.

    ``markers`` (Z, G, R, N) and ``unexplained`` (Z, G, R) are sqrt(w) J and sqrt(w) e, rows beyond
    a group's own zero; ``precision`` (N, N) is the priors'. The goal of a state that is off by d is
    off by ``constant - 2 linear d + d quadratic d`` (Z,), (Z, N), (Z, N, N): a mean square in m².
    """

    markers: Float[np.ndarray, "Z G R N"]
    unexplained: Float[np.ndarray, "Z G R"]
    precision: Float[np.ndarray, "N N"]
    constant: Float[np.ndarray, " Z"]
    linear: Float[np.ndarray, "Z N"]
    quadratic: Float[np.ndarray, "Z N N"]


@dataclass(frozen=True, eq=False)
class Posed:
    """A posed person: the state (betas, pose (J, 3), trans) that fits their surface best, and the
    surface (V, 3).
    """

    betas: Float[np.ndarray, " B"]
    pose: Float[np.ndarray, "J 3"]
    trans: Float[np.ndarray, " 3"]
    surface: Float[np.ndarray, "V 3"]


def precision(
    body: BodyModel, prior: PosePrior, free: float = SELECTION.free
) -> Float[np.ndarray, "N N"]:
    """The priors' precision of betas, pose (root first) and trans: of unit betas, and of the pose
    prior as it is.
    """
    weights = MoshWeights()
    count = body.num_betas
    size = count + 3 * body.num_joints + 3
    out = np.eye(size) / free**2
    out[:count, :count] = weights.betas * np.eye(count)
    joints = slice(count + 3, size - 3)
    out[joints, joints] = weights.pose * prior.for_joints(body.joint_names).precision
    return out


def by_state(
    body: BodyModel, person: Posed, vertices: Int[np.ndarray, " n"]
) -> Float[np.ndarray, "n 3 N"]:
    """Derivatives of vertices by betas, pose and trans."""
    jacobian = surface_jacobian(body, person.betas, person.pose, person.trans, vertices=vertices)
    return _columns(jacobian.vertices_betas, jacobian.vertices_pose)


def _columns(by_betas: np.ndarray, by_pose: np.ndarray) -> Float[np.ndarray, "n 3 N"]:
    count = len(by_betas)
    place = np.broadcast_to(np.eye(3), (count, 3, 3))
    return np.concatenate([by_betas, by_pose.reshape(count, 3, -1), place], axis=2)


def linearised(
    body: BodyModel,
    prior: PosePrior,
    people: Sequence[Posed],
    candidates: Candidates,
    goal: str = "surface",
    region: str = "all",
    noise: float = NOISE,
    free: float = SELECTION.free,
) -> Linearised:
    """The problem of choosing among ``candidates``, for posed people. noise, free: as in
    `SelectionSettings`.

    Raises HabitusError for a goal or a region that there is not.
    """
    rows = 3 * max(map(len, candidates.groups))
    parts = [
        _of_person(body, person, candidates, rows, noise, *_goal(body, person, goal, region))
        for person in people
    ]
    markers, unexplained, constant, linear, quadratic = (
        np.stack(each) for each in zip(*parts, strict=True)
    )
    return Linearised(
        markers, unexplained, precision(body, prior, free), constant, linear, quadratic
    )


def _of_person(
    body: BodyModel,
    person: Posed,
    candidates: Candidates,
    rows: int,
    noise: float,
    moved: Float[np.ndarray, "n 3 N"],
    off: Float[np.ndarray, "n 3"],
) -> tuple[np.ndarray, ...]:
    by_markers = by_state(body, person, candidates.vertices)
    here = body(person.betas, person.pose, person.trans, vertices=candidates.vertices).vertices
    left = person.surface[candidates.vertices] - here
    markers = np.zeros((len(candidates.groups), rows, by_markers.shape[2]))
    unexplained = np.zeros((len(candidates.groups), rows))
    for k, group in enumerate(candidates.groups):
        own = 3 * len(group)
        markers[k, :own] = by_markers[list(group)].reshape(own, -1) / noise
        unexplained[k, :own] = left[list(group)].ravel() / noise
    flat = moved.reshape(-1, moved.shape[2])
    miss = off.ravel()
    count = len(moved)
    return markers, unexplained, miss @ miss / count, flat.T @ miss / count, flat.T @ flat / count


def _goal(body: BodyModel, person: Posed, goal: str, region: str) -> tuple[np.ndarray, np.ndarray]:
    """What the goal's points move by (n, 3, N), and how far they are off (n, 3) at the best
    state.
    """
    if goal not in GOALS:
        raise HabitusError(f"goal is {goal!r}; expected one of {', '.join(GOALS)}")
    joints = region_joints(body, region)
    if goal == "pose":
        jacobian = surface_jacobian(body, person.betas, person.pose, person.trans, vertices=[0])
        moved = _columns(jacobian.joints_betas, jacobian.joints_pose)[joints]
        return moved, np.zeros((len(joints), 3))
    some = region_vertices(body, joints)
    if goal == "shape":
        size = body.num_betas + 3 * body.num_joints + 3
        moved = np.zeros((len(some), 3, size))
        moved[..., : body.num_betas] = body.shapedirs[some] - body.shapedirs[some].mean(axis=0)
        return moved, np.zeros((len(some), 3))
    here = body(person.betas, person.pose, person.trans, vertices=some).vertices
    return by_state(body, person, some), person.surface[some] - here


def region_joints(body: BodyModel, region: str) -> Int[np.ndarray, " n"]:
    """The joints of a region. Raises HabitusError where there is none."""
    if region not in REGIONS:
        raise HabitusError(f"region is {region!r}; expected one of {', '.join(REGIONS)}")
    parts = REGIONS[region]
    joints = [
        k
        for k, name in enumerate(body.joint_names)
        if not parts or name.rpartition("_")[2] in parts
    ]
    if not joints:
        raise HabitusError(
            f"the body {body.name} has no joints of the {region}; expected SMPL's names"
        )
    return np.array(joints)


def region_vertices(
    body: BodyModel, joints: Int[np.ndarray, " n"], most: int = 1500
) -> Int[np.ndarray, " m"]:
    """Vertices that ride on these joints, evenly thinned."""
    strongest = body.skinning_index[np.arange(body.num_vertices), body.skinning_value.argmax(1)]
    vertices = np.flatnonzero(np.isin(strongest, joints))
    return vertices[
        np.unique(np.linspace(0, len(vertices) - 1, min(most, len(vertices))).astype(int))
    ]
