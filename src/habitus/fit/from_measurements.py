"""A body from some of its measurements: the likeliest person who has them, and what they leave
open.

Shape coefficients are normal of unit variance about those of the mean person that a survey measured
(zero, where the body knows of none); a measurement m(betas) is known to a standard deviation. The
likeliest betas are the minimum of

    |betas - mean|^2 + sum over given measurements k of (m_k(betas) - value_k)^2 / sd_k^2,

by `habitus.solve`. Their covariance is that of the problem linearised there.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float
from scipy.special import chdtrc, ndtri

from habitus.body.measurement_names import find_measurement, si_unit
from habitus.body.model import BodyModel
from habitus.errors import HabitusError
from habitus.solve.least_squares import Tolerances
from habitus.solve.minimize import minimize
from habitus.solve.terms import GemanMcClure, Term

_LEAST = 1e-6  # weight of a measurement in the covariance
_WORST = 4  # measurements that a refusal names, those that fit least
_WORDS = {"m": "metres", "kg": "kilograms"}
Given = float | tuple[float, float]


@dataclass(frozen=True)
class EstimateSettings:
    """Settings of `estimate_body`."""

    precision: float = 0.002
    """Standard deviation of a given measurement, as a share of it, where none is given: 3.5 mm of
    1.75 m."""
    angle_sd: float = 2.0
    """Degrees: standard deviation of a given angle."""
    robust: float = np.inf
    """Standard deviations of a given measurement beyond which it counts less and less (Geman and
    McClure's loss), after a solve in which all count: for tapes of foreign definitions."""
    max_sd: float = 6.0
    """Standard deviations from the mean person beyond which measurements are refused: nobody is
    there."""
    iterations: int = 60
    """Accepted and refused, at most; people within 6 sd take fewer than ten."""
    tolerance: float = 1e-5
    """Last step as a share of the betas' length: the step after it would be its square."""
    cost_tolerance: float = 1e-6
    """Relative fall of the energy that a step must promise: less is a thousandth of a beta's
    standard deviation, where extremes of vertices and hulls of tapes have kinks."""
    difference: float = 0.05
    """Standard deviations of a beta: difference quotient of the measurements by the betas."""
    max_step: float = 2.0
    """Standard deviations: longest step of a beta; measurements are linear within it."""


ESTIMATE = EstimateSettings()


@dataclass(frozen=True, eq=False)
class BodyEstimate:
    """The likeliest person with some measurements.

    ``betas`` (B,) and their ``covariance`` (B, B) belong to ``body``. ``measurements`` are that
    person's, all of them (m, kg), and ``spread`` how far each is left open by what was given: a
    standard deviation. ``given`` is what was asked for. ``sd_from_mean`` says how rare such a
    person is: as a normal variable so many sd from its mean. ``space`` and ``age`` (years) say
    which body it is, where it was made for an age. ``status``: how the solve ended
    (`habitus.solve.least_squares.SolveResult`). ``weights``: what each given measurement counted,
    1 where it was believed, towards 0 where a robust loss set it aside.
    """

    body: BodyModel
    betas: Float[np.ndarray, " B"]
    covariance: Float[np.ndarray, "B B"]
    measurements: Mapping[str, float]
    spread: Mapping[str, float]
    given: Mapping[str, float]
    sd_from_mean: float
    space: str = ""
    age: float | None = None
    status: str = "converged"
    weights: Mapping[str, float] = field(default_factory=dict)

    @property
    def betas_sd(self) -> Float[np.ndarray, " B"]:
        """What is left open of each shape coefficient: 1 where nothing was told of it."""
        return np.sqrt(np.diag(self.covariance))


def estimate_body(
    body: BodyModel, measurements: Mapping[str, Given], settings: EstimateSettings = ESTIMATE
) -> BodyEstimate:
    """The likeliest person of a shape space who has these measurements (m, kg; each a value, or a
    value and its sd).

    Names may be short ("height", "waist", see `habitus.body.measurement_names`). Raises
    HabitusError for a measurement that the body does not have, for a value that is none, and for
    people such as nobody is.
    """
    mean = {
        name: float(values[0])
        for name, values in body.measure_people(np.zeros((1, body.num_betas))).items()
    }
    targets = _read(measurements, mean, settings)
    every = list(mean)
    names = list(targets)
    rows = [every.index(name) for name in names]
    values, noise = np.array([*targets.values()]).reshape(-1, 2).T
    betas, status = _likeliest(body, rows, values, noise, settings)
    measured, slopes = _linear(body, betas, settings.difference)
    loss = GemanMcClure(settings.robust)
    off = ((values - measured[rows]) / noise)[:, None]
    weights = loss.weights(off)
    believed = weights > 0.5
    energy = float(np.sum((betas - _typical(body)) ** 2) + np.sum(off[believed] ** 2))
    noise = noise / np.sqrt(np.maximum(weights, _LEAST))
    if (rare := _as_sd(energy, int(believed.sum()))) > settings.max_sd:
        worst = np.argsort(-np.abs((values - measured[rows]) / noise))[:_WORST]
        said = ", ".join(f"{names[k]} {values[k]:.4g}" for k in sorted(worst))
        raise HabitusError(
            f"{said}: {rare:.0f} standard deviations from the people that {body.called} knows, "
            "where nobody is; "
            "check the numbers (metres and kilograms)"
        )
    covariance = np.eye(len(betas)) - _gain(slopes[rows], noise) @ slopes[rows]
    spread = np.sqrt(np.maximum(np.einsum("mb,bc,mc->m", slopes, covariance, slopes), 0.0))
    return BodyEstimate(
        body,
        betas,
        0.5 * (covariance + covariance.T),
        dict(zip(every, measured.tolist(), strict=True)),
        dict(zip(every, spread.tolist(), strict=True)),
        dict(zip(names, values.tolist(), strict=True)),
        rare,
        body.name,
        status=status,
        weights=dict(zip(names, weights.tolist(), strict=True)),
    )


def _read(
    measurements: Mapping[str, Given], mean: Mapping[str, float], settings: EstimateSettings
) -> dict[str, tuple[float, float]]:
    """Each measurement's full name, value and standard deviation."""
    targets: dict[str, tuple[float, float]] = {}
    for spelling, given in measurements.items():
        name = find_measurement(spelling, mean)
        if name in targets:
            raise HabitusError(f"{name} is given twice; give it once")
        pair = np.array(
            given if isinstance(given, tuple) else (given, np.nan), dtype=np.float64
        ).ravel()
        value, sd = pair if len(pair) == 2 else (np.nan, np.nan)
        if np.isnan(sd):
            sd = settings.angle_sd if name.endswith("_deg") else settings.precision * value
        if not (np.isfinite(value) and value > 0 and sd > 0):
            raise HabitusError(
                f"{spelling} is {given!r}; expected a number above 0, or such a number and its sd"
            )
        if not 0.1 < value / mean[name] < 10 and not name.endswith("_deg"):
            raise HabitusError(
                f"{spelling} is {value:g}; people have about {mean[name]:.3g}: give "
                f"{_WORDS.get(si_unit(name), si_unit(name))}"
            )
        targets[name] = float(value), float(sd)
    return targets


def _likeliest(
    body: BodyModel,
    rows: list[int],
    values: np.ndarray,
    noise: np.ndarray,
    settings: EstimateSettings,
) -> tuple[Float[np.ndarray, " B"], str]:
    """Betas at the minimum of `measurement_terms`, and how the solve ended."""
    betas = _typical(body)
    if not rows:
        return betas, "converged"

    def too_far(iteration: int, now: dict[str, np.ndarray], cost: float) -> bool:
        return bool(np.linalg.norm(now["betas"]) > 3 * settings.max_sd)

    status = "converged"
    for scale in (np.inf, settings.robust)[: 1 + int(np.isfinite(settings.robust))]:
        solution = minimize(
            measurement_terms(body, rows, values, noise, settings.difference, scale),
            {"betas": betas},
            "dogleg",
            max_iterations=settings.iterations,
            max_step={"betas": settings.max_step},
            tolerances=Tolerances(step=settings.tolerance, cost=settings.cost_tolerance),
            callback=too_far,
        )
        betas, status = solution.values["betas"], solution.status
    return betas, status


def measurement_terms(
    body: BodyModel,
    rows: list[int],
    values: Float[np.ndarray, " K"],
    noise: Float[np.ndarray, " K"],
    difference: float = ESTIMATE.difference,
    robust: float = np.inf,
) -> dict[str, Term]:
    """The energy of betas (B,): |betas - mean person|^2 and the given measurements (``rows`` of all
    that the body has) against ``values`` in units of ``noise`` (m, kg, degrees), with a robust loss
    where its scale, in these units, is finite.
    """
    mean = _typical(body)
    quick = len(body.measure_people(mean[None], sewing=False))
    sewing = max(rows, default=0) >= quick

    def given(betas):
        def jacobians():
            return {"betas": _linear(body, betas, difference, sewing)[1][rows] / noise[:, None]}

        here = np.array([each[0] for each in body.measure_people(betas[None], sewing).values()])
        off = (here[rows] - values) / noise
        return (off if loss is None else off[:, None]), jacobians

    loss = GemanMcClure(robust) if np.isfinite(robust) else None
    prior = Term(lambda betas: (betas - mean, {"betas": np.eye(len(mean))}))
    return {"measurements": Term(given, robust=loss), "betas": prior}


def _typical(body: BodyModel) -> np.ndarray:
    """Betas (B,) of the mean person."""
    return np.zeros(body.num_betas) if body.people_mean is None else body.people_mean


def _linear(
    body: BodyModel, betas: np.ndarray, difference: float, sewing: bool = True
) -> tuple[np.ndarray, np.ndarray]:
    """All measurements (M,) at these betas, those for sewing where asked for, and their slopes (M,
    B).
    """
    changed = betas + np.vstack([0 * betas, difference * np.eye(len(betas))])
    table = np.array(list(body.measure_people(changed, sewing).values()))
    return table[:, 0], (table[:, 1:] - table[:, :1]) / difference


def _gain(slopes: np.ndarray, noise: np.ndarray) -> np.ndarray:
    """What a unit of each measurement's surprise moves the betas, (B, K)."""
    return np.linalg.solve(slopes @ slopes.T + np.diag(noise**2), slopes).T


def _as_sd(energy: float, count: int) -> float:
    """A sum of ``count`` squares as a normal variable's distance from its mean that is as rarely
    exceeded.
    """
    if count == 0:
        return 0.0
    rarely = float(chdtrc(count, energy))
    return float(-ndtri(rarely / 2)) if rarely > 1e-300 else float(np.sqrt(energy))
