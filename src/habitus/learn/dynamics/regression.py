"""The autoregressive regressor of dynamic coefficients (S eq. 17; Dyna's eq. 22), by ridge regression.

Within a sequence the shape is one, so that its rows are [delta_{t-1}, delta_{t-2}, u_t] times [1, betas]: normal
equations of all sequences are sums of Kronecker products of small ones.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from habitus.body.dynamics import DynamicsRegressor, free_run
from habitus.learn.dynamics.options import DynamicsOptions

_FOLDS = 4
_TINY = 1e-10  # ridge of what is not held back, against round-off
BEYOND = 1.5
"""Controls up to so many times the largest that was seen are believed."""


@dataclass(frozen=True, eq=False)
class Example:
    """A sequence to learn from: coefficients (T, D), controls (T, C), and the person's betas (B,)."""

    coefficients: Float[np.ndarray, "T D"]
    controls: Float[np.ndarray, "T C"]
    betas: Float[np.ndarray, " B"]


@dataclass(frozen=True)
class Choice:
    """A way to learn, and the error of what runs free on motions held out: 1 is that of a body without dynamics."""

    shape_features: int
    ridge: float
    error: float


@dataclass(frozen=True, eq=False)
class Learned:
    """The regressor, and the choices that there were, best first."""

    regressor: DynamicsRegressor
    choices: tuple[Choice, ...]


def learn_regressor(
    examples: Sequence[Example],
    group: Int[np.ndarray, " N"],
    sizes: Float[np.ndarray, " D"],
    joints: tuple[str, ...],
    rate_hz: float,
    options: DynamicsOptions,
) -> Learned:
    """Ridge and number of shape coefficients by the error of running free on held-out groups; then all data together.

    ``group``: examples of one group are held out together. ``sizes`` (D,): how much a unit of each coefficient moves.
    """
    equations = _Equations.of(examples, joints, rate_hz, options)
    folds = _folds(group)
    varied = np.ptp([example.betas for example in examples], axis=0) > 0
    known = int(np.argmin(varied)) if not varied.all() else len(varied)  # the first so many differ between people
    features = sorted({min(count, known, len(set(group)) - 1) for count in options.shape_features})
    choices = [
        Choice(count, ridge, float(error))
        for count in features
        for ridge, error in zip(
            options.ridge, _held_out_errors(equations, folds, sizes, count, options.ridge), strict=True
        )
    ]
    choices.sort(key=lambda choice: choice.error)
    best, everything = choices[0], np.ones(len(examples), dtype=bool)
    (regressor,) = equations.solve(everything, best.shape_features, [best.ridge])
    return Learned(regressor, tuple(choices))


@dataclass(frozen=True, eq=False)
class _Equations:
    """Each example's own normal equations in scaled controls, from which those of any choice are summed."""

    examples: Sequence[Example]
    left: list[Float[np.ndarray, "P P"]]
    right: list[Float[np.ndarray, "P D"]]
    rows: Int[np.ndarray, " N"]
    scale: Float[np.ndarray, " C"]
    joints: tuple[str, ...]
    rate_hz: float
    controls: str

    @staticmethod
    def of(
        examples: Sequence[Example], joints: tuple[str, ...], rate_hz: float, options: DynamicsOptions
    ) -> "_Equations":
        total = sum(len(example.controls) for example in examples)
        square = sum((example.controls**2).sum(0) for example in examples)
        scale = np.sqrt(square / total)
        scale[scale <= 0] = 1.0
        left, right = [], []
        for example in examples:
            d = example.coefficients
            rows = np.concatenate([d[1:-1], d[:-2], example.controls[2:] / scale], axis=1)
            left.append(rows.T @ rows)
            right.append(rows.T @ d[2:])
        counts = np.array([max(len(example.coefficients) - 2, 0) for example in examples])
        return _Equations(examples, left, right, counts, scale, joints, rate_hz, options.controls)

    def solve(self, used: np.ndarray, shapes: int, ridges: Sequence[float]) -> list[DynamicsRegressor]:
        """The regressors of the ``used`` examples (N,) with the first ``shapes`` coefficients, one a ridge."""
        count, size, blocks = self.right[0].shape[1], self.left[0].shape[0], 1 + shapes
        left, right = np.zeros((blocks, size, blocks, size)), np.zeros((blocks, size, count))
        for k in np.flatnonzero(used).tolist():
            factors = np.concatenate([[1.0], self.examples[k].betas[:shapes]])
            for row, factor in enumerate(factors):
                left[row] += (factor * self.left[k])[:, None] * factors[:, None]
                right[row] += factor * self.right[k]
        matrix, right = left.reshape(blocks * size, -1), right.reshape(blocks * size, count)
        total, found = max(int(self.rows[used].sum()), 1), []
        for ridge in ridges:
            held = np.full((blocks, size), ridge)
            held[:, : 2 * count] = _TINY
            tables = np.linalg.solve(matrix + total * np.diag(held.ravel()), right)
            found.append(self._regressor(tables.reshape(blocks, size, count), used))
        return found

    def _regressor(self, tables: Float[np.ndarray, "S1 P D"], used: np.ndarray) -> DynamicsRegressor:
        blocks, _, count = tables.shape
        shown = [example for example, take in zip(self.examples, used, strict=True) if take]
        betas = np.array([example.betas[: blocks - 1] for example in shown])
        history = tables[:, : 2 * count].reshape(blocks, 2, count, count).swapaxes(-1, -2)
        drive = (tables[:, 2 * count :] / self.scale[:, None]).swapaxes(-1, -2)
        return DynamicsRegressor(
            history=np.ascontiguousarray(history),
            drive=np.ascontiguousarray(drive),
            joints=self.joints,
            rate_hz=self.rate_hz,
            limits=BEYOND * np.max([np.abs(example.controls).max(0, initial=0.0) for example in shown], axis=0),
            reach=np.array([betas.min(0), betas.max(0)]),
            controls=self.controls,
        )


def predicted(regressor: DynamicsRegressor, example: Example) -> Float[np.ndarray, "T D"]:
    """The coefficients of an example's motion, running free from rest."""
    history, drive = regressor.of_person(example.betas)
    return free_run(history, np.clip(example.controls, -regressor.limits, regressor.limits) @ drive.T)


def _held_out_errors(
    equations: _Equations,
    folds: list[tuple[np.ndarray, np.ndarray]],
    sizes: np.ndarray,
    shapes: int,
    ridges: Sequence[float],
) -> Float[np.ndarray, " R"]:
    """Mean squared error of all examples, each without having been seen, over their mean square; one a ridge."""
    wrong, whole = np.zeros(len(ridges)), 0.0
    for used, judged in folds:
        regressors = equations.solve(used, shapes, ridges)
        for k in np.flatnonzero(judged).tolist():
            example = equations.examples[k]
            whole += float(((example.coefficients * sizes) ** 2).sum())
            for r, regressor in enumerate(regressors):
                wrong[r] += float((((predicted(regressor, example) - example.coefficients) * sizes) ** 2).sum())
    return wrong / max(whole, 1e-300)


def _folds(group: Int[np.ndarray, " N"]) -> list[tuple[np.ndarray, np.ndarray]]:
    """Which examples are learned from and which are judged, in up to four folds; a single group is judged on itself."""
    _, number = np.unique(group, return_inverse=True)
    count = min(_FOLDS, int(number.max()) + 1)
    if count == 1:
        return [(np.ones(len(group), dtype=bool), np.ones(len(group), dtype=bool))]
    return [(number % count != k, number % count == k) for k in range(count)]
