"""Errors of soft tissue in motion (S 6): of the surface's position, velocity and acceleration; and
shape and motion of moving people of whom only surfaces are known (the pose of a personalised
template).
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from habitus.body.model import BodyModel
from habitus.body.soft_tissue import dynamics_of, simulate_soft_tissue
from habitus.errors import HabitusError
from habitus.evaluate.posable import PosableBody
from habitus.evaluate.surface_fit import fit_surface
from habitus.learn.dynamics.sequences import MovingSurface, rest_residuals
from habitus.learn.posing.rig import RestPerson, Rig
from habitus.learn.steps.poses import fit_pose
from habitus.parallel.workers import Threads, Workers

MODES = ("without", "simulated", "fitted")
"""Without dynamics; predicted from the motion; the best coefficients that the blend shapes have for
each surface.
"""
QUANTITIES = ("place_mm", "velocity_mm_s", "acceleration_m_s2")
_BATCH = 32


@dataclass(frozen=True, eq=False)
class DynamicsErrors:
    """Of one sequence: ``errors`` (3 ways, 3 quantities), root mean squares over vertices and
    frames, in the units of `QUANTITIES`; and root mean squares (T,) of the simulated coefficients
    and of the fitted ones in each frame.
    """

    name: str
    subject: str
    errors: Float[np.ndarray, "3 3"]
    simulated: Float[np.ndarray, " T"]
    fitted: Float[np.ndarray, " T"]


def evaluate_dynamics(
    body: BodyModel,
    sequences: Sequence[MovingSurface],
    workers: Workers | None = None,
    strength: float = 1.0,
) -> tuple[DynamicsErrors, ...]:
    """Errors of moving surfaces that were not learned from: without dynamics, simulated, and at
    best.

    The whole surface is compared: errors of pose blend shapes count in all three. Where the
    sequence has the surface without dynamics in each pose (from a simulation), that replaces the
    body's. Sequences have betas, pose and trans. Raises HabitusError for a body without
    dynamics and sequences that are not of it.
    """
    directions = dynamics_of(body).directions.reshape(3 * body.num_vertices, -1)
    sequences = [sequence.for_body(body) for sequence in sequences]
    back = np.linalg.pinv(directions)
    courses: list[list[np.ndarray]] = [[] for _ in sequences]
    for k, rows in rest_residuals(body, sequences, workers or Threads(1)):
        courses[k].append(rows @ back.T)
    result = []
    for sequence, course in zip(sequences, courses, strict=True):
        assert (
            sequence.betas is not None and sequence.pose is not None and sequence.trans is not None
        )
        fitted = np.concatenate(course)
        simulated = simulate_soft_tissue(
            body, sequence.betas, sequence.pose, sequence.trans, sequence.rate_hz, strength
        )
        squares = _squares(body, sequence, (np.zeros_like(fitted), simulated, fitted))
        sizes = (np.sqrt((course**2).mean(1)) for course in (simulated, fitted))
        result.append(DynamicsErrors(sequence.name, sequence.subject, np.sqrt(squares), *sizes))
    return tuple(result)


def _squares(
    body: BodyModel, sequence: MovingSurface, courses: Sequence[np.ndarray]
) -> Float[np.ndarray, "3 3"]:
    """Mean squares of the errors of three courses of coefficients, in the units of `QUANTITIES`."""
    frames = len(sequence)
    sums = np.zeros((3, 3))
    counts = np.zeros(3)
    for first in range(0, frames, _BATCH):
        frame_numbers = np.arange(max(first - 1, 0), min(first + _BATCH + 1, frames))
        inside = slice(
            first - frame_numbers[0], first - frame_numbers[0] + min(_BATCH, frames - first)
        )
        truth = np.array([sequence.registrations.read(int(frame)) for frame in frame_numbers])
        for mode, course in enumerate(courses):
            error = _surfaces(body, sequence, frame_numbers, course) - truth
            for quantity, values in enumerate(_changes(error, sequence.rate_hz, inside)):
                seen = values[np.isfinite(values)]
                sums[mode, quantity] += (seen**2).sum()
                counts[quantity] += seen.size if mode == 0 else 0
    return 3 * sums / np.maximum(counts, 1) * np.array([1e3, 1e3, 1.0]) ** 2


def _changes(
    error: np.ndarray, rate_hz: float, inside: slice
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Errors of place in the ``inside`` frames, of velocity and acceleration where these have both
    neighbours.
    """
    inner = slice(max(inside.start, 1), min(inside.stop, len(error) - 1))
    before, here, after = (error[inner.start + step : inner.stop + step] for step in (-1, 0, 1))
    return error[inside], 0.5 * rate_hz * (after - before), rate_hz**2 * (after - 2 * here + before)


def _surfaces(
    body: BodyModel, sequence: MovingSurface, frames: np.ndarray, course: np.ndarray
) -> np.ndarray:
    assert sequence.pose is not None and sequence.trans is not None
    posed = (sequence.betas, sequence.pose[frames], sequence.trans[frames])
    result = body(*posed, dynamics=course[frames]).vertices
    if sequence.vertex_ids is not None:
        result = result[:, sequence.vertex_ids]
    if sequence.still is None:
        return result
    at_rest = body(*posed, vertices=sequence.vertex_ids).vertices
    return result + np.array([sequence.still[int(frame)] for frame in frames]) - at_rest


_SHAPE_FRAMES = 5  # of each person, spread over all frames
_STEPS = 6  # of the solver in each frame, which begins where the last one ended


@dataclass(frozen=True, eq=False)
class _Shared:
    body: BodyModel
    rig: Rig
    betas: dict[str, Float[np.ndarray, " _"]]


def with_motions(
    body: BodyModel, sequences: Sequence[MovingSurface], workers: Workers
) -> Iterator[MovingSurface]:
    """The sequences, with fitted motions where these are unknown: a person's shape is fitted to a
    few frames, then pose and translation to each.

    Raises HabitusError where such registrations have holes or hold some of the vertices only.
    """
    unknown = [
        sequence
        for sequence in sequences
        if sequence.pose is None or sequence.trans is None or sequence.betas is None
    ]
    for sequence in unknown:
        if (
            sequence.vertex_ids is not None
            or sequence.registrations.num_vertices != body.num_vertices
        ):
            raise HabitusError(
                f"{sequence.name}: betas, pose or trans are missing, and its "
                f"{sequence.registrations.num_vertices} vertices are not the {body.num_vertices} "
                f"of {body.name}; expected betas, pose and trans in the data"
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
    for sequence in sequences:
        frames.setdefault(sequence.subject, []).extend((sequence, k) for k in range(len(sequence)))
    items = [
        (subject, *shots[int(at)])
        for subject, shots in frames.items()
        for at in np.linspace(0, len(shots) - 1, min(_SHAPE_FRAMES, len(shots)))
    ]
    shapes: dict[str, list[np.ndarray]] = {}
    for (subject, _, _), betas in zip(items, workers.map(_shape, body, items), strict=True):
        shapes.setdefault(subject, []).append(betas)
    return {subject: np.mean(fitted, axis=0) for subject, fitted in shapes.items()}


def _shape(body: BodyModel, item: tuple[str, MovingSurface, int]) -> Float[np.ndarray, " B"]:
    return fit_surface(
        PosableBody(body), _whole_surface(item[1], item[2]), num_betas=body.num_betas
    ).betas


def _with_motion(shared: _Shared, sequence: MovingSurface) -> MovingSurface:
    if sequence.subject not in shared.betas or (
        sequence.pose is not None and sequence.trans is not None and sequence.betas is not None
    ):
        return sequence
    body = shared.body
    betas = shared.betas[sequence.subject]
    person = RestPerson(
        body.rest_vertices(betas), body.rest_joints(betas), betas[: body.shape_features]
    )
    first = fit_surface(
        PosableBody(body), _whole_surface(sequence, 0), num_betas=body.num_betas, betas=betas
    )
    pose = first.pose
    poses = []
    places = []
    for frame in range(len(sequence)):
        fit = fit_pose(
            shared.rig, person, _whole_surface(sequence, frame), pose, max_iterations=_STEPS
        )
        pose = fit.pose
        poses.append(fit.pose)
        places.append(fit.trans)
    names = body.joint_names
    return replace(
        sequence, betas=betas, pose=np.array(poses), trans=np.array(places), joint_names=names
    )


def _whole_surface(sequence: MovingSurface, frame: int) -> Float[np.ndarray, "V 3"]:
    vertices = sequence.registrations.read(frame)
    if not np.isfinite(vertices).all():
        raise HabitusError(
            f"{sequence.name}: frame {frame} has holes, and betas, pose or trans are missing; "
            "expected them in the data"
        )
    return vertices
