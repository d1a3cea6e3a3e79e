"""The two measures of S 5.1 against the number of shape coefficients: model and pose
generalisation.

Model generalisation fits shape and pose to each registration: can the model take the form of new
people in new poses? Pose generalisation takes the shape that was estimated from one registration of
a person and fits only the pose to all others of that person: are shape and pose told apart? Both
report the mean absolute vertex-to-vertex distance, over observed vertices only (their weights,
where registrations have some).
"""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from habitus.errors import HabitusError
from habitus.evaluate.counts import COUNTS
from habitus.evaluate.posable import Posable
from habitus.evaluate.surface_fit import Fit
from habitus.mesh.registrations import Registrations, Vertices
from habitus.parallel.workers import Threads, Workers

_ALONE = Threads(1)


@dataclass(frozen=True, eq=False)
class Generalisation:
    """Errors of a model fitted to N registrations with each of K numbers of shape coefficients.

    ``measure`` is "model" or "pose". ``errors`` (m) are means over vertices of the distance to the
    registration's vertices, ``per_vertex`` (m) means over registrations, NaN where none shows a
    vertex. ``clean_errors`` and ``clean_per_vertex`` are distances to true vertices, where these
    are known. ``rows`` say which of the registrations given they are. ``betas`` are filled up with
    zeros.
    """

    measure: str
    model: str
    counts: tuple[int, ...]
    registrations: tuple[str, ...]
    subjects: tuple[str, ...]
    errors: Float[np.ndarray, "K N"]
    per_vertex: Float[np.ndarray, "K V"]
    seconds: Float[np.ndarray, "K N"]
    rows: Int[np.ndarray, " N"]
    betas: Float[np.ndarray, "K N B"]
    pose: Float[np.ndarray, "K N J 3"]
    trans: Float[np.ndarray, "K N 3"]
    clean_errors: Float[np.ndarray, "K N"] | None = None
    clean_per_vertex: Float[np.ndarray, "K V"] | None = None

    @property
    def means(self) -> Float[np.ndarray, " K"]:
        """Mean error (m) for each number of coefficients: the curves of S 5.1, Figs. 11 and 12."""
        return self.errors.mean(1)

    @property
    def clean_means(self) -> Float[np.ndarray, " K"] | None:
        """The same against true vertices."""
        return None if self.clean_errors is None else self.clean_errors.mean(1)

    def shape(self, k: int, registration: int) -> Float[np.ndarray, " B"]:
        """The coefficients that were estimated from a registration, as many as ``counts[k]``."""
        return self.betas[k, registration, : self.counts[k]]

    def start(self, k: int, registration: int) -> Fit:
        """The result of that fit, as a start for others."""
        pose = self.pose[k, registration]
        trans = self.trans[k, registration]
        return Fit(self.shape(k, registration), pose, trans, np.zeros((0, 3)))


def model_generalisation(
    model: Posable,
    registrations: Registrations,
    counts: Sequence[int] = COUNTS,
    *,
    clean: Vertices | None = None,
    workers: Workers = _ALONE,
) -> Generalisation:
    """Fit shape and pose to each registration with the first k coefficients, for each k of
    ``counts`` (S 5.1).

    Each fit starts where the one with fewer coefficients ended, so that errors tell of the model
    rather than of local minima. ``counts`` beyond what the model has become all that it has; 0 is
    the mean shape. ``clean`` (N, V, 3), in metres, are the registrations' vertices without noise.
    Raises HabitusError if there is nothing to fit.
    """
    used = _counts(model, counts)
    _check(registrations, clean)
    shared = _Shared(model, registrations, clean, used)
    fits = list(workers.map(_free_shape, shared, range(len(registrations))))
    return _gathered("model", model, used, registrations, np.arange(len(registrations)), fits)


def pose_generalisation(
    model: Posable,
    registrations: Registrations,
    fitted: Generalisation,
    *,
    clean: Vertices | None = None,
    workers: Workers = _ALONE,
) -> Generalisation:
    """Fit only the pose to all registrations of a person but the first, with the shape of that
    first one (S 5.1).

    ``fitted`` is the same model's `model_generalisation` on the same registrations: it gives the
    shapes, and the poses to start from. Raises HabitusError if it is not, or if nobody has two
    registrations.
    """
    _check(registrations, clean)
    if (fitted.measure, fitted.model, fitted.registrations) != (
        "model",
        model.name,
        registrations.name,
    ):
        raise HabitusError(
            f"shapes come from {fitted.model}, {fitted.measure} generalisation on "
            f"{len(fitted.registrations)} meshes; "
            f"expected model generalisation of {model.name} on these {len(registrations)} "
            "registrations"
        )
    first = {subject: k for k, subject in reversed(list(enumerate(registrations.subject)))}
    others = [k for k, subject in enumerate(registrations.subject) if first[subject] != k]
    if not others:
        raise HabitusError(
            "nobody has more than one registration; pose generalisation needs people in several "
            "poses"
        )
    sources = tuple(first[subject] for subject in registrations.subject)
    shared = _Shared(model, registrations, clean, fitted.counts, fitted, sources)
    fits = list(workers.map(_fixed_shape, shared, others))
    return _gathered("pose", model, fitted.counts, registrations, np.array(others), fits)


@dataclass(frozen=True, eq=False)
class _Shared:
    """Constants of all fits: the model, the meshes, and for fixed shapes the registrations that
    these come from.
    """

    model: Posable
    registrations: Registrations
    clean: Vertices | None
    counts: tuple[int, ...]
    fitted: Generalisation | None = None
    sources: tuple[int, ...] = ()


@dataclass(frozen=True, eq=False)
class _Fits:
    """One registration's fits: distances of vertices to it and to the truth for each number of
    coefficients, and the vertices' weights.
    """

    fits: list[Fit]
    seconds: list[float]
    distances: Float[np.ndarray, "K V"]
    clean: Float[np.ndarray, "K V"] | None
    weight: Float[np.ndarray, " V"]


def _free_shape(shared: _Shared, which: int) -> _Fits:
    start: Fit | None = None

    def fit(target: np.ndarray, weights: np.ndarray | None, k: int) -> Fit:
        nonlocal start
        count = shared.counts[k]
        start = shared.model.fit(target, num_betas=count, start=start, weights=weights)
        return start

    return _fits(fit, shared, which)


def _fixed_shape(shared: _Shared, which: int) -> _Fits:
    fitted = shared.fitted
    assert fitted is not None

    def fit(target: np.ndarray, weights: np.ndarray | None, k: int) -> Fit:
        shape = fitted.shape(k, shared.sources[which])
        return shared.model.fit(
            target,
            num_betas=len(shape),
            betas=shape,
            start=fitted.start(k, which),
            weights=weights,
        )

    return _fits(fit, shared, which)


def _fits(
    fit: Callable[[np.ndarray, np.ndarray | None, int], Fit], shared: _Shared, which: int
) -> _Fits:
    target, weights = shared.registrations.read_seen(which)
    truth = None if shared.clean is None else np.asarray(shared.clean[which], float)
    fits = []
    seconds = []
    distances = []
    true_distances = []
    for k in range(len(shared.counts)):
        begin = time.perf_counter()
        fits.append(fit(target, weights, k))
        seconds.append(time.perf_counter() - begin)
        distances.append(np.linalg.norm(fits[-1].vertices - target, axis=-1))
        if truth is not None:
            true_distances.append(np.linalg.norm(fits[-1].vertices - truth, axis=-1))
    return _Fits(
        fits,
        seconds,
        np.array(distances),
        None if truth is None else np.array(true_distances),
        np.ones(len(target)) if weights is None else weights,
    )


def _gathered(
    measure: str,
    model: Posable,
    counts: tuple[int, ...],
    given: Registrations,
    rows: Int[np.ndarray, " N"],
    fits: Sequence[_Fits],
) -> Generalisation:
    registrations = given.take(rows)
    largest = counts[-1]
    cleans = [each.clean for each in fits if each.clean is not None]
    weights = np.stack([each.weight for each in fits])
    betas = [
        [np.pad(fit.betas, (0, largest - len(fit.betas))) for fit in each.fits] for each in fits
    ]
    return Generalisation(
        measure=measure,
        model=model.name,
        counts=counts,
        registrations=registrations.name,
        subjects=registrations.subject,
        errors=_over_vertices([each.distances for each in fits], weights),
        per_vertex=_over_registrations([each.distances for each in fits], weights),
        seconds=np.array([each.seconds for each in fits]).T,
        rows=rows,
        betas=np.swapaxes(np.array(betas), 0, 1),
        pose=np.stack([[fit.pose for fit in each.fits] for each in fits], 1),
        trans=np.stack([[fit.trans for fit in each.fits] for each in fits], 1),
        clean_errors=_over_vertices(cleans, weights) if cleans else None,
        clean_per_vertex=_over_registrations(cleans, weights) if cleans else None,
    )


def _over_vertices(
    distances: Sequence[Float[np.ndarray, "K V"]], weights: Float[np.ndarray, "N V"]
) -> Float[np.ndarray, "K N"]:
    """Weighted means over the vertices of each registration."""
    pairs = zip(distances, weights, strict=True)
    return np.stack([np.average(each, axis=1, weights=weight) for each, weight in pairs], 1)


def _over_registrations(
    distances: Sequence[Float[np.ndarray, "K V"]], weights: Float[np.ndarray, "N V"]
) -> Float[np.ndarray, "K V"]:
    """Weighted means over the registrations, NaN for vertices that none of them shows."""
    total = weights.sum(0)
    sums = np.einsum("nkv,nv->kv", np.stack(distances), weights)
    return np.where(total > 0.0, sums / np.where(total > 0.0, total, 1.0), np.nan)


def _counts(model: Posable, counts: Sequence[int]) -> tuple[int, ...]:
    used = tuple(sorted({min(k, model.num_betas) for k in counts}))
    if not used or used[0] < 0:
        raise HabitusError(
            f"numbers of shape coefficients are {list(counts)}; expected one or more, none below 0"
        )
    return used


def _check(registrations: Registrations, clean: Vertices | None) -> None:
    if len(registrations) == 0:
        raise HabitusError(
            "there are no registrations to measure generalisation on; give some of the set 'test'"
        )
    if clean is not None and tuple(clean.shape) != tuple(registrations.vertices.shape):
        raise HabitusError(
            f"clean vertices have shape {tuple(clean.shape)}; expected that of the registrations, "
            f"{tuple(registrations.vertices.shape)}"
        )
