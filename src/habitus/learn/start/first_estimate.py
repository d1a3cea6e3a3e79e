"""Initial estimate of the alternation (S 4.1, S 4.3): skinning weights and joints of the template,
poses from edges; or people and poses that are known, to begin with or to hold fixed.
"""

import numpy as np
from jaxtyping import Bool, Float

from habitus.body.model import BodyModel
from habitus.body.pose_features import POSE_FEATURES
from habitus.errors import HabitusError
from habitus.learn.estimate import Anatomy, Estimate, Problem
from habitus.learn.options import TrainOptions
from habitus.learn.posing.rig import RestPerson, Rig, influences
from habitus.learn.posing.surface import surface
from habitus.learn.start.segmentation import diffuse_weights, ring_regressor
from habitus.learn.steps.pose_shapes import allowed_pose_shapes
from habitus.learn.steps.poses import EdgeDistance, PoseFit, edge_distance, fit_pose, mean_of
from habitus.learn.steps.weights import candidate_joints
from habitus.mesh.known import Known
from habitus.mesh.registrations import Registrations
from habitus.mesh.template import Template
from habitus.parallel.workers import Workers, in_blocks
from habitus.rotations import rotvec_from_matrix

_ITERATIONS = 30
_LEAST = 4  # vertices of a part that tell how it is turned


def state_problem(
    registrations: Registrations,
    template: Template,
    options: TrainOptions,
    body: BodyModel | None = None,
) -> Problem:
    """The multi-pose registrations with what is known of the template, or of the ``body`` that
    training starts from.
    """
    if options.start == "body":
        weights, regressor = _of_body(body, template, options)
    else:
        initial = diffuse_weights(template, options.settings)
        index, value = influences(initial, options.influences)
        weights = np.zeros_like(initial)
        np.put_along_axis(weights, index, value, 1)
        regressor = ring_regressor(template)
    anatomy = Anatomy(template.mirror, template.joint_mirror, regressor)
    candidates = candidate_joints(template.parents, weights)
    return Problem(registrations, anatomy, weights, candidates, options, registrations.weighted)


def _of_body(
    body: BodyModel | None, template: Template, options: TrainOptions
) -> tuple[Float[np.ndarray, "V J"], Float[np.ndarray, "J V"]]:
    """Skinning weights and joint regressor of a body; weights with as many joints a vertex as asked
    for, or as it has where they are fixed.
    """
    if (
        body is None
        or body.parents != template.parents
        or body.num_vertices != template.num_vertices
    ):
        raise HabitusError(
            "start 'body' without a body of this template; expected the one that the template is of"
        )
    if "skinning_weights" in options.fixed:
        return body.skinning_weights, body.joint_regressor
    index, value = influences(body.skinning_weights, options.influences)
    weights = np.zeros_like(body.skinning_weights)
    np.put_along_axis(weights, index, value, 1)
    return weights, body.joint_regressor


def initial_rig(problem: Problem, template: Template, body: BodyModel | None = None) -> Rig:
    """W_I, and pose blend shapes of zero, or the body's own (none where the options want none)."""
    options = problem.options
    if "skinning_weights" in options.fixed:
        assert body is not None
        index = body.skinning_index
        value = body.skinning_value
    else:
        index, value = influences(problem.initial_weights, options.influences)
    posedirs = _initial_pose_shapes(problem, template, body if options.start == "body" else None)
    return Rig(
        template.parents,
        options.skinning,
        options.pose_features,
        options.shape_features,
        index,
        value,
        posedirs,
    )


def _initial_pose_shapes(
    problem: Problem, template: Template, body: BodyModel | None
) -> Float[np.ndarray, "V 3 F"] | None:
    options = problem.options
    if options.pose_shapes == "none":
        return None
    per_joint = POSE_FEATURES[options.pose_features].per_joint
    blocks = 1 + options.shape_features
    none = np.zeros((template.num_vertices, 3, (template.num_joints - 1) * per_joint * blocks))
    if body is None or body.posedirs is None:
        return none
    if (body.pose_features, body.shape_features) != (options.pose_features, 0):
        if "posedirs" not in options.fixed:
            return none
        raise HabitusError(
            f"posedirs fixed, but those of {body.name} are driven by {body.pose_features!r} and "
            f"{body.shape_features} "
            f"shape coefficients; expected {options.pose_features!r} alone"
        )
    posedirs = body.smpl_posedirs()
    if posedirs is None:
        return none
    return posedirs if "posedirs" in options.fixed else allowed_pose_shapes(problem, posedirs)


def initial_estimate(
    problem: Problem, template: Template, workers: Workers, body: BodyModel | None = None
) -> Estimate:
    """All subjects have the template's shape; poses are fitted by edges, which vary little with
    shape (eq. 15). What is known of people and poses takes the place of both, where training starts
    from a body.
    """
    check_known(problem, body)
    rig = initial_rig(problem, template, body)
    regressor = problem.anatomy.regressor
    templates = people(problem, template.vertices, body)
    joints = regressor @ templates
    descriptors = np.zeros((len(templates), problem.options.shape_features))
    persons = [RestPerson(*each) for each in zip(templates, joints, descriptors, strict=True)]
    general = RestPerson(
        template.vertices, regressor @ template.vertices, np.zeros(problem.options.shape_features)
    )
    is_known = known_poses(problem)
    pose = np.zeros((len(is_known), template.num_joints, 3))
    trans = np.zeros((len(is_known), 3))
    known = np.flatnonzero(is_known)
    unknown = np.flatnonzero(~is_known)
    fits = known_fits(problem, rig, persons, known, workers)
    fits += edge_poses(rig, general, template.part, problem.registrations.take(unknown), workers)
    for row, fit in zip([*known, *unknown], fits, strict=True):
        pose[row], trans[row] = fit.pose, fit.trans
    return Estimate(rig, templates, joints, descriptors, pose, trans)


def edge_poses(
    rig: Rig, person: RestPerson, part: np.ndarray, registrations: Registrations, workers: Workers
) -> list[PoseFit]:
    """The pose of every registration by a general person's edges (eq. 15), from a start by rigid
    parts.
    """
    distance = edge_distance(registrations.faces, registrations.num_vertices)
    shared = (rig, person, part, registrations, distance)
    return [
        fit
        for block in workers.map(_edge_poses, shared, in_blocks(len(registrations), 8))
        for fit in block
    ]


def _edge_poses(
    shared: tuple[Rig, RestPerson, np.ndarray, Registrations, EdgeDistance], rows: range
) -> list[PoseFit]:
    rig, person, part, registrations, distance = shared
    return [edge_pose(rig, person, part, *registrations.read_seen(row), distance) for row in rows]


def edge_pose(
    rig: Rig,
    person: RestPerson,
    part: np.ndarray,
    target: Float[np.ndarray, "V 3"],
    weight: Float[np.ndarray, " V"] | None,
    distance: EdgeDistance,
) -> PoseFit:
    """The pose of one registration (eq. 15)."""
    start = pose_by_parts(person.template, target, part, rig.parents, weight)
    return fit_pose(
        rig, person, target, start, distance=distance.weighted(weight), max_iterations=_ITERATIONS
    )


def pose_by_parts(
    rest: Float[np.ndarray, "V 3"],
    target: Float[np.ndarray, "V 3"],
    part: np.ndarray,
    parents: tuple[int, ...],
    weight: Float[np.ndarray, " V"] | None = None,
) -> Float[np.ndarray, "J 3"]:
    """A rough pose: how each part has turned as if it were rigid; small parts turn with their
    parent.
    """
    world = np.empty((len(parents), 3, 3))
    seen = True if weight is None else weight > 0
    for joint, parent in enumerate(parents):
        rows = np.flatnonzero((part == joint) & seen)
        world[joint] = np.eye(3) if parent < 0 else world[parent]
        if len(rows) >= _LEAST:
            a = rest[rows] - rest[rows].mean(0)
            b = target[rows] - target[rows].mean(0)
            u, _, vt = np.linalg.svd(b.T @ a)
            world[joint] = u @ np.diag([1.0, 1.0, np.sign(np.linalg.det(u @ vt))]) @ vt
    above = np.stack([np.eye(3) if parent < 0 else world[parent] for parent in parents])
    return rotvec_from_matrix(above.transpose(0, 2, 1) @ world)


def check_known(problem: Problem, body: BodyModel | None) -> None:
    """Raise HabitusError where what is known is not by this body's joints and shape directions, or
    does not suffice for what is held fixed.
    """
    known = problem.registrations.known
    fixed = problem.options.fixed
    data = problem.registrations
    if known is not None and body is not None and problem.options.start == "body":
        for name, array, count in (
            ("pose", known.pose, body.num_joints),
            ("betas", known.betas, body.num_betas),
        ):
            if array is not None and (
                array.shape[1] != count if name == "pose" else array.shape[1] > count
            ):
                raise HabitusError(
                    f"the registrations' {name} have {array.shape[1]} rows of numbers, "
                    f"{body.name} has {count}; "
                    "expected those of this body: choose its joints (--joints) or another body"
                )
    for word, is_known in (("people", known_people(problem)), ("poses", known_poses(problem))):
        if word in fixed and not is_known.all():
            names_of = data.subjects if word == "people" else data.name
            raise HabitusError(
                f"{word} fixed, but those of {int((~is_known).sum())} of {len(is_known)} (first "
                f"{names_of[int((~is_known).argmax())]}) "
                f"are unknown; expected {'betas or rest' if word == 'people' else 'pose'} in the "
                "dataset"
            )


def known_poses(problem: Problem) -> Bool[np.ndarray, " N"]:
    """The registrations whose poses are known and are to be started from."""
    return _known(problem).known_rows("pose", len(problem.registrations))


def known_people(problem: Problem) -> Bool[np.ndarray, " S"]:
    """The subjects whose rest surfaces are known and are to be started from."""
    data = problem.registrations
    known = _known(problem)
    by_betas = known.known_rows("betas", len(data))[_first_rows(problem)]
    return np.array([subject in known.rest for subject in data.subjects], bool) | by_betas


def people(
    problem: Problem, general: Float[np.ndarray, "V 3"], body: BodyModel | None
) -> Float[np.ndarray, "S V 3"]:
    """Rest surfaces (m) of the subjects: those known, the general one of the others."""
    data = problem.registrations
    known = _known(problem)
    surfaces = np.repeat(general[None], problem.subjects, 0)
    for k, (subject, row) in enumerate(zip(data.subjects, _first_rows(problem), strict=True)):
        if subject in known.rest:
            surfaces[k] = known.rest[subject]
        elif known.betas is not None and body is not None and np.isfinite(known.betas[row]).all():
            surfaces[k] = body.rest_vertices(known.betas[row])
    return surfaces


def known_fits(
    problem: Problem, rig: Rig, persons: list[RestPerson], rows: np.ndarray, workers: Workers
) -> list[PoseFit]:
    """The known poses of some registrations; their places as known, or where they lie best."""
    blocks = [rows[block.start : block.stop] for block in in_blocks(len(rows), 32)]
    return [
        fit for block in workers.map(_known_fits, (problem, rig, persons), blocks) for fit in block
    ]


def _known_fits(shared: tuple[Problem, Rig, list[RestPerson]], rows: np.ndarray) -> list[PoseFit]:
    problem, rig, persons = shared
    known = _known(problem)
    data = problem.registrations
    fits = []
    places = known.known_rows("trans", len(data))
    assert known.pose is not None
    for row in rows:
        pose = known.pose[row]
        if known.trans is not None and places[row]:
            fits.append(PoseFit(pose, known.trans[row], np.nan))
            continue
        target, weight = data.read_seen(row)
        away = target - surface(rig, persons[data.subject_index[row]], pose)
        fits.append(PoseFit(pose, mean_of(away, weight), np.nan))
    return fits


def _known(problem: Problem) -> Known:
    """What is known, where training starts from a body; nothing otherwise: joints would be other
    ones.
    """
    known = problem.registrations.known
    return Known() if known is None or problem.options.start != "body" else known


def _first_rows(problem: Problem) -> np.ndarray:
    """The first registration of each subject."""
    return np.array([problem.rows_of(k)[0] for k in range(problem.subjects)], np.int64)
