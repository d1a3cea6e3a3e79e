"""Shape and motion of moving people of whom only surfaces are known (S 6: the pose of a
personalised template).
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from habitus.body.model import BodyModel
from habitus.errors import HabitusError
from habitus.evaluate.posable import PosableBody
from habitus.evaluate.surface_fit import fit_surface
from habitus.learn.dynamics.sequences import MovingSurface
from habitus.learn.posing.rig import RestPerson, Rig
from habitus.learn.steps.poses import fit_pose
from habitus.parallel.workers import Workers

_SHAPE_FRAMES = 5  # of each person, spread over all frames
_STEPS = 6  # of the solver in each frame, which begins where the last one ended


@dataclass(frozen=True, eq=False)
class _Shared:
    body: BodyModel
    rig: Rig
    betas: dict[str, Float[np.ndarray, " B"]]


def with_motions(
    body: BodyModel, sequences: Sequence[MovingSurface], workers: Workers
) -> Iterator[MovingSurface]:
    """The sequences, those without a motion with one: a shape a person from a few frames, then pose
    and place in each.

    Raises HabitusError where such registrations have holes or are of some vertices only: these want
    a motion told.
    """
    unknown = [
        one for one in sequences if one.pose is None or one.trans is None or one.betas is None
    ]
    for one in unknown:
        if one.vertex_ids is not None or one.registrations.num_vertices != body.num_vertices:
            raise HabitusError(
                f"{one.name}: no betas, pose and trans are told, and its "
                f"{one.registrations.num_vertices} vertices are "
                f"not all {body.num_vertices} of {body.name}; tell the motion"
            )
    rig = Rig(
        body.parents, body.skinning, body.pose_features, body.shape_features,
        body.skinning_index, body.skinning_value, body.smpl_posedirs(),
    )  # fmt: skip
    shared = _Shared(body, rig, _shapes(body, unknown, workers))
    yield from workers.map(_with_motion, shared, list(sequences))


def _shapes(
    body: BodyModel, sequences: Sequence[MovingSurface], workers: Workers
) -> dict[str, np.ndarray]:
    """The shape of each person: the mean of those fitted to a few frames."""
    frames: dict[str, list[tuple[MovingSurface, int]]] = {}
    for one in sequences:
        frames.setdefault(one.subject, []).extend((one, k) for k in range(len(one)))
    items = [
        (subject, *found[int(at)])
        for subject, found in frames.items()
        for at in np.linspace(0, len(found) - 1, min(_SHAPE_FRAMES, len(found)))
    ]
    found: dict[str, list[np.ndarray]] = {}
    for (subject, _, _), betas in zip(items, workers.map(_shape, body, items), strict=True):
        found.setdefault(subject, []).append(betas)
    return {subject: np.mean(each, axis=0) for subject, each in found.items()}


def _shape(body: BodyModel, item: tuple[str, MovingSurface, int]) -> Float[np.ndarray, " B"]:
    return fit_surface(PosableBody(body), _whole(item[1], item[2]), num_betas=body.num_betas).betas


def _with_motion(shared: _Shared, one: MovingSurface) -> MovingSurface:
    if one.subject not in shared.betas or (
        one.pose is not None and one.trans is not None and one.betas is not None
    ):
        return one
    body = shared.body
    betas = shared.betas[one.subject]
    person = RestPerson(
        body.rest_vertices(betas), body.rest_joints(betas), betas[: body.shape_features]
    )
    first = fit_surface(PosableBody(body), _whole(one, 0), num_betas=body.num_betas, betas=betas)
    pose = first.pose
    poses = []
    places = []
    for frame in range(len(one)):
        found = fit_pose(shared.rig, person, _whole(one, frame), pose, max_iterations=_STEPS)
        pose = found.pose
        poses.append(found.pose)
        places.append(found.trans)
    names = body.joint_names
    return replace(
        one, betas=betas, pose=np.array(poses), trans=np.array(places), joint_names=names
    )


def _whole(one: MovingSurface, frame: int) -> Float[np.ndarray, "V 3"]:
    vertices = one.registrations.read(frame)
    if not np.isfinite(vertices).all():
        raise HabitusError(
            f"{one.name}: frame {frame} has holes and no betas, pose and trans are told; tell the "
            "motion"
        )
    return vertices
