"""How well a body tells soft tissue in motion (S 6): errors of the surface's place, velocity and
acceleration.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from habitus.body.model import BodyModel
from habitus.body.soft_tissue import dynamics_of, simulate_soft_tissue
from habitus.learn.dynamics.sequences import MovingSurface, rest_residuals
from habitus.parallel.workers import Threads, Workers

WAYS = ("without", "simulated", "fitted")
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

    What is compared is the body's whole surface: what pose blend shapes get wrong counts in all
    three alike. Where a simulation tells the surface at rest in each pose, that takes the place of
    the body's. Sequences know betas, pose and trans. Raises HabitusError for a body without
    dynamics and sequences that are not of it.
    """
    directions = dynamics_of(body).directions.reshape(3 * body.num_vertices, -1)
    sequences = [one.for_body(body) for one in sequences]
    back = np.linalg.pinv(directions)
    courses: list[list[np.ndarray]] = [[] for _ in sequences]
    for k, rows in rest_residuals(body, sequences, workers or Threads(1)):
        courses[k].append(rows @ back.T)
    found = []
    for one, course in zip(sequences, courses, strict=True):
        assert one.betas is not None and one.pose is not None and one.trans is not None
        fitted = np.concatenate(course)
        simulated = simulate_soft_tissue(
            body, one.betas, one.pose, one.trans, one.rate_hz, strength
        )
        squares = _squares(body, one, (np.zeros_like(fitted), simulated, fitted))
        sizes = (np.sqrt((each**2).mean(1)) for each in (simulated, fitted))
        found.append(DynamicsErrors(one.name, one.subject, np.sqrt(squares), *sizes))
    return tuple(found)


def _squares(
    body: BodyModel, one: MovingSurface, courses: Sequence[np.ndarray]
) -> Float[np.ndarray, "3 3"]:
    """Mean squares of the errors of three courses of coefficients, in the units of `QUANTITIES`."""
    frames = len(one)
    sums = np.zeros((3, 3))
    counts = np.zeros(3)
    for first in range(0, frames, _BATCH):
        some = np.arange(max(first - 1, 0), min(first + _BATCH + 1, frames))
        own = slice(first - some[0], first - some[0] + min(_BATCH, frames - first))
        truth = np.array([one.registrations.read(int(frame)) for frame in some])
        for way, course in enumerate(courses):
            wrong = _surfaces(body, one, some, course) - truth
            for quantity, values in enumerate(_changes(wrong, one.rate_hz, own)):
                seen = values[np.isfinite(values)]
                sums[way, quantity] += (seen**2).sum()
                counts[quantity] += seen.size if way == 0 else 0
    return 3 * sums / np.maximum(counts, 1) * np.array([1e3, 1e3, 1.0]) ** 2


def _changes(
    wrong: np.ndarray, rate_hz: float, own: slice
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Errors of place in the ``own`` frames, of velocity and acceleration where these have both
    neighbours.
    """
    inner = slice(max(own.start, 1), min(own.stop, len(wrong) - 1))
    before, here, after = (wrong[inner.start + step : inner.stop + step] for step in (-1, 0, 1))
    return wrong[own], 0.5 * rate_hz * (after - before), rate_hz**2 * (after - 2 * here + before)


def _surfaces(
    body: BodyModel, one: MovingSurface, frames: np.ndarray, course: np.ndarray
) -> np.ndarray:
    assert one.pose is not None and one.trans is not None
    posed = (one.betas, one.pose[frames], one.trans[frames])
    found = body(*posed, dynamics=course[frames]).vertices
    if one.vertex_ids is not None:
        found = found[:, one.vertex_ids]
    if one.still is None:
        return found
    at_rest = body(*posed, vertices=one.vertex_ids).vertices
    return found + np.array([one.still[int(frame)] for frame in frames]) - at_rest
