"""Markers chosen one after another: the one that is missed least goes, or the one that helps most
comes (M 7, Fig. 5).

A marker more or less changes the inverse G by a matrix of rank 3 (Woodbury), so that all candidates
of a step are told from one G: with U = G Jᵀ, X = (1 ± J U)⁻¹ and r what is left of the marker, d
changes by ± U X r and G by -+ U X Uᵀ. That is some N² operations a candidate and person, where a
fit takes ten times N³.
"""

from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from habitus.fit.selection.problem import Linearised
from habitus.parallel.workers import Threads, Workers

ADD = 1.0
REMOVE = -1.0


class Step(NamedTuple):
    """A group of markers that came or went, the groups that there are then, and their error (m,
    root mean square).
    """

    group: int | None
    groups: tuple[int, ...]
    error: float


def removals(
    problem: Linearised, start: Sequence[int], fewest: int, workers: Workers | None = None
) -> Iterator[Step]:
    """From the groups ``start`` down to ``fewest``, each time without the one that is missed
    least.
    """
    yield from _path(problem, start, REMOVE, lambda groups: len(groups) > fewest, workers)


def additions(
    problem: Linearised, start: Sequence[int], max_markers: int, workers: Workers | None = None
) -> Iterator[Step]:
    """From the groups ``start`` up to ``max_markers``, each time with the one that helps most."""
    yield from _path(problem, start, ADD, lambda groups: len(groups) < max_markers, workers)


def set_error(problem: Linearised, groups: Sequence[int]) -> float:
    """The error of one set of groups (m): root of the mean of squares over people, points and what
    noise does.
    """
    return float(np.sqrt(_state(problem, groups)[2].mean()))


def _path(
    problem: Linearised,
    start: Sequence[int],
    sign: float,
    goes_on: Callable[[Sequence[int]], bool],
    workers: Workers | None,
) -> Iterator[Step]:
    groups = tuple(start)
    yield Step(None, groups, set_error(problem, groups))
    while goes_on(groups):
        every = range(problem.markers.shape[1])
        free = [k for k in every if (k in groups) == (sign == REMOVE)]
        if not free:
            return
        errors = step_errors(problem, groups, free, sign, workers)
        best = free[int(np.argmin(errors))]
        groups = (*groups, best) if sign == ADD else tuple(k for k in groups if k != best)
        yield Step(best, groups, float(np.sqrt(errors.min())))


def step_errors(
    problem: Linearised,
    groups: Sequence[int],
    free: Sequence[int],
    sign: float,
    workers: Workers | None = None,
) -> Float[np.ndarray, " F"]:
    """The mean squared error (m²) after each of the ``free`` groups came (`ADD`) or went
    (`REMOVE`).
    """
    people = list(range(len(problem.markers)))
    shared = problem, tuple(groups), list(free), sign
    return np.mean(list((workers or Threads(1)).map(_errors_of_person, shared, people)), axis=0)


def _errors_of_person(
    shared: tuple[Linearised, tuple[int, ...], list[int], float], person: int
) -> np.ndarray:
    problem, groups, free, sign = shared
    inverse, off, error = (each[0] for each in _state(problem, groups, slice(person, person + 1)))
    markers = problem.markers[person, free]
    quadratic = problem.quadratic[person]
    count, rows, size = markers.shape
    moved = (markers.reshape(-1, size) @ inverse).reshape(count, rows, size)  # Uᵀ
    spread = (moved.reshape(-1, size) @ quadratic).reshape(count, rows, size)  # Uᵀ Q
    gain = np.linalg.inv(np.eye(rows) + sign * moved @ np.swapaxes(markers, 1, 2))
    change = sign * (gain @ (problem.unexplained[person, free] - markers @ off)[..., None])[..., 0]
    slope = spread @ off - moved @ problem.linear[person]
    curved = spread @ np.swapaxes(moved, 1, 2)
    quadratics = np.einsum("fr,frs,fs->f", change, curved, change)
    return (
        error
        + 2.0 * (change * slope).sum(1)
        + quadratics
        - sign * np.einsum("frs,fsr->f", gain, curved)
    )


def _state(
    problem: Linearised, groups: Sequence[int], people: slice = slice(None)
) -> tuple[Float[np.ndarray, "Z N N"], Float[np.ndarray, "Z N"], Float[np.ndarray, " Z"]]:
    """G, d and the mean squared error of each person with these groups."""
    size = problem.precision.shape[0]
    chosen = problem.markers[people][:, list(groups)].reshape(
        -1, len(groups) * problem.markers.shape[2], size
    )
    left = problem.unexplained[people][:, list(groups)].reshape(len(chosen), -1)
    inverse = np.linalg.inv(np.swapaxes(chosen, 1, 2) @ chosen + problem.precision)
    off = (inverse @ (np.swapaxes(chosen, 1, 2) @ left[..., None]))[..., 0]
    quadratic = problem.quadratic[people]
    linear = problem.linear[people]
    error = (
        problem.constant[people]
        - 2.0 * (linear * off).sum(1)
        + np.einsum("zn,znm,zm->z", off, quadratic, off)
    )
    return inverse, off, error + np.einsum("znm,zmn->z", quadratic, inverse)
