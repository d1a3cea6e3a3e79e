"""The autoregressive regressor of dynamic coefficients (S eq. 17; Dyna's eq. 22), by ridge
regression.

Within a sequence the shape is one, so that its rows are [delta_{t-1}, delta_{t-2}, u_t] times [1,
betas]: normal equations of all sequences are sums of Kronecker products of small ones.

Coefficients of real surfaces hold noise, which makes histories from least squares die down too
fast. What runs free holds none: with its history as instruments (Zhat^T Z X = Zhat^T Y in the place
of Z^T Z X = Z^T Y, a few rounds, each with what the last one predicts) the estimate is right in the
mean.

The coefficients are those of the principal directions (S 6: PCA) of more surfaces than memory
holds, which are found in one pass.
"""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from jaxtyping import Float, Int

from habitus.body.dynamics import CONTROLS, DynamicsRegressor, free_run
from habitus.errors import HabitusError
from habitus.learn.dynamics.settings import DYNAMICS, DynamicsSettings


@dataclass(frozen=True)
class DynamicsOptions:
    """Options of the training of dynamic blend shapes (S 6).

    Of ``shape_features`` and ``ridge`` the training takes what runs free best on held-out motions.
    Raises HabitusError for options that make no sense.
    """

    components: int = 8
    """Number of dynamic blend shapes."""
    controls: Literal["joints", "smpl"] = "joints"
    """Inputs: each joint's own linear acceleration, spin and angular acceleration, or those of S 6
    (joint angles' rates, the root's velocity and acceleration).
    """
    shape_features: tuple[int, ...] = (0, 1, 2, 4)
    """Numbers of shape coefficients on which the regressor may depend."""
    ridge: tuple[float, ...] = (1e-8, 1e-7, 1e-6, 1e-5, 1e-4, 1e-3, 1e-2)
    """Ridge terms to choose from, as shares of each control's variance."""
    rank: int = 64
    """Directions kept while surfaces are read."""
    personal: bool = True
    """Count a person's mean residual to the person's own template (S 6), not to the dynamics."""
    settings: DynamicsSettings = DYNAMICS
    """Tuning of the trainer's parts."""

    def __post_init__(self) -> None:
        if self.controls not in CONTROLS:
            raise HabitusError(
                f"controls are {self.controls!r}; expected one of {', '.join(CONTROLS)}"
            )
        if not 1 <= self.components <= self.rank:
            raise HabitusError(
                f"{self.components} components asked of {self.rank} directions; expected 1 to "
                f"{self.rank}"
            )
        if not self.ridge or min(self.ridge) <= 0:
            raise HabitusError(f"ridge is {self.ridge}; expected one share or more, all above 0")
        if not self.shape_features or min(self.shape_features) < 0:
            raise HabitusError(
                f"shape_features are {self.shape_features}; expected one number or more, none "
                "below 0"
            )


@dataclass(frozen=True, eq=False)
class Components:
    """D blend shapes (m a root mean square), their coefficients in every row, and each one's share
    of the variance.
    """

    directions: Float[np.ndarray, "V 3 D"]
    coefficients: Float[np.ndarray, "T D"]
    shares: Float[np.ndarray, " D"]


@dataclass(eq=False)
class _Sketch:
    """T rows as ``coefficients`` of orthonormal directions; of those only so many that matter most
    are kept.
    """

    directions: Float[np.ndarray, "k M"]
    coefficients: list[Float[np.ndarray, "_ k"]]
    energy: float = 0.0

    def add(self, rows: Float[np.ndarray, "n M"]) -> None:
        known = rows @ self.directions.T
        rest = rows - known @ self.directions
        values, axes = np.linalg.eigh(rest @ rest.T)
        used = values > 1e-12 * max(float((rows**2).sum()), 1e-300)
        sizes = np.sqrt(values[used])
        fresh = (axes[:, used] / sizes).T @ rest
        fresh -= (fresh @ self.directions.T) @ self.directions
        pad = ((0, 0), (0, len(fresh)))
        self.coefficients = [np.pad(each, pad) for each in self.coefficients]
        self.coefficients.append(np.concatenate([known, axes[:, used] * sizes], axis=1))
        self.directions = np.concatenate([self.directions, fresh])
        self.energy += float((rows**2).sum())

    def cut(self, rank: int) -> None:
        axes = np.linalg.eigh(sum(each.T @ each for each in self.coefficients))[1][:, ::-1][
            :, :rank
        ]
        self.coefficients = [each @ axes for each in self.coefficients]
        self.directions = axes.T @ self.directions


def principal_components(
    blocks: Iterable[Float[np.ndarray, "_ M"]],
    count: int,
    rank: int,
    group: Int[np.ndarray, " T"] | None = None,
) -> Components:
    """The ``count`` principal directions of all rows, about each ``group``'s own mean; of group -1
    about zero.

    No more than ``rank`` directions and what one block adds are held at once: exact where no more
    matter. Each direction's largest entry is positive. Raises HabitusError where nothing moves.
    """
    sketch = None
    for rows in blocks:
        rows = np.asarray(rows, np.float64)
        sketch = sketch or _Sketch(np.zeros((0, rows.shape[1])), [])
        sketch.add(rows)
        if len(sketch.directions) > 2 * rank:
            sketch.cut(rank)
    if sketch is None or sketch.energy <= 0.0:
        raise HabitusError(
            "no surface differs from what the body says: there are no dynamics to learn"
        )
    table = np.concatenate(sketch.coefficients)
    lost = sketch.energy - float((table**2).sum())
    if group is not None:
        for label in np.unique(group[group >= 0]):
            table[group == label] -= table[group == label].mean(0)
    values, axes = np.linalg.eigh(table.T @ table)
    values = values[::-1][:count]
    axes = axes[:, ::-1][:, :count]
    if len(values) < count or values[-1] <= 1e-10 * values[0]:
        have = int((values > 1e-10 * values[0]).sum())
        raise HabitusError(
            f"{count} components asked of surfaces that move in {have} ways; ask for as many, or "
            "fewer"
        )
    sizes = np.sqrt(values / len(table))
    rows = axes.T @ sketch.directions
    sign = np.sign(rows[np.arange(count), np.abs(rows).argmax(1)])
    directions = (rows * (sign * sizes)[:, None]).T.reshape(-1, 3, count)
    total = float((table**2).sum()) + max(lost, 0.0)
    return Components(np.ascontiguousarray(directions), table @ axes * sign / sizes, values / total)


_TINY = 1e-10  # ridge of what is not held back, against round-off


@dataclass(frozen=True, eq=False)
class Example:
    """A sequence to learn from: coefficients (T, D), controls (T, C), and the person's betas
    (B,).
    """

    coefficients: Float[np.ndarray, "T D"]
    controls: Float[np.ndarray, "T C"]
    betas: Float[np.ndarray, " B"]


@dataclass(frozen=True)
class Choice:
    """A way to learn, and the error of what runs free on motions held out: 1 is that of a body
    without dynamics.
    """

    shape_features: int
    ridge: float
    error: float
    rounds: int = 0
    """Of instruments."""


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
    """Ridge and number of shape coefficients by the error of running free on held-out groups; then
    all data together.

    ``group``: examples of one group are held out together. ``sizes`` (D,): how much a unit of each
    coefficient moves.
    """
    equations = _Equations.of(examples, joints, rate_hz, options)
    folds = _folds(group, options.settings.folds)
    varied = np.ptp([example.betas for example in examples], axis=0) > 0
    known = (
        int(np.argmin(varied)) if not varied.all() else len(varied)
    )  # the first so many differ between people
    features = sorted({min(count, known, len(set(group)) - 1) for count in options.shape_features})
    choices = [
        choice
        for count in features
        for ridge in options.ridge
        for choice in _judged(equations, folds, sizes, Choice(count, ridge, 0.0))
    ]
    choices.sort(key=lambda choice: choice.error)
    *_, regressor = _rounds(
        equations, np.ones(len(examples), dtype=bool), choices[0], choices[0].rounds
    )
    return Learned(regressor, tuple(choices))


@dataclass(frozen=True, eq=False)
class _Equations:
    """Each example's own normal equations in scaled controls, from which those of any choice are
    summed.
    """

    examples: Sequence[Example]
    left: list[Float[np.ndarray, "P P"]]
    right: list[Float[np.ndarray, "P D"]]
    rows: Int[np.ndarray, " N"]
    scale: Float[np.ndarray, " C"]
    joints: tuple[str, ...]
    rate_hz: float
    controls: str
    settings: DynamicsSettings

    @staticmethod
    def of(
        examples: Sequence[Example],
        joints: tuple[str, ...],
        rate_hz: float,
        options: DynamicsOptions,
    ) -> "_Equations":
        total = sum(len(example.controls) for example in examples)
        square = sum((example.controls**2).sum(0) for example in examples)
        scale = np.sqrt(square / total)
        scale[scale <= 0] = 1.0
        products = [_products(example, example.coefficients, scale) for example in examples]
        left, right = (list(each) for each in zip(*products, strict=True))
        counts = np.array([max(len(example.coefficients) - 2, 0) for example in examples])
        return _Equations(
            examples,
            left,
            right,
            counts,
            scale,
            joints,
            rate_hz,
            options.controls,
            options.settings,
        )

    def instrumented(self, regressor: DynamicsRegressor, used: np.ndarray) -> "_Equations":
        """The same with the histories of what this regressor predicts as instruments, of the
        examples ``used``.
        """
        left = list(self.left)
        right = list(self.right)
        for k in np.flatnonzero(used).tolist():
            left[k], right[k] = _products(
                self.examples[k], predicted(regressor, self.examples[k]), self.scale
            )
        return replace(self, left=left, right=right)

    def solve(self, used: np.ndarray, shapes: int, ridge: float) -> DynamicsRegressor:
        """The regressor of the ``used`` examples (N,) with the first ``shapes`` coefficients."""
        count = self.right[0].shape[1]
        size = self.left[0].shape[0]
        blocks = 1 + shapes
        left = np.zeros((blocks, size, blocks, size))
        right = np.zeros((blocks, size, count))
        for k in np.flatnonzero(used).tolist():
            factors = np.concatenate([[1.0], self.examples[k].betas[:shapes]])
            for row, factor in enumerate(factors):
                left[row] += (factor * self.left[k])[:, None] * factors[:, None]
                right[row] += factor * self.right[k]
        matrix = left.reshape(blocks * size, -1)
        right = right.reshape(blocks * size, count)
        held = np.full((blocks, size), ridge)
        held[:, : 2 * count] = _TINY
        tables = np.linalg.solve(
            matrix + max(int(self.rows[used].sum()), 1) * np.diag(held.ravel()), right
        )
        return self._regressor(tables.reshape(blocks, size, count), used)

    def _regressor(
        self, tables: Float[np.ndarray, "S1 P D"], used: np.ndarray
    ) -> DynamicsRegressor:
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
            limits=self.settings.control_range
            * np.max([np.abs(example.controls).max(0, initial=0.0) for example in shown], axis=0),
            reach=np.array([betas.min(0), betas.max(0)]),
            controls=self.controls,
        )


def _products(
    example: Example, course: Float[np.ndarray, "T D"], scale: Float[np.ndarray, " C"]
) -> tuple[Float[np.ndarray, "P P"], Float[np.ndarray, "P D"]]:
    """Zhat^T Z and Zhat^T Y: rows of the example, and those with the history of ``course`` in the
    place of its own.
    """
    d = example.coefficients
    controls = example.controls[2:] / scale
    own, other = (np.concatenate([each[1:-1], each[:-2], controls], axis=1) for each in (d, course))
    return other.T @ own, other.T @ d[2:]


def _rounds(
    equations: _Equations, used: np.ndarray, choice: Choice, count: int
) -> Iterator[DynamicsRegressor]:
    """The regressor without instruments, then those of each round with them."""
    regressor = equations.solve(used, choice.shape_features, choice.ridge)
    yield regressor
    for _ in range(count):
        regressor = equations.instrumented(regressor, used).solve(
            used, choice.shape_features, choice.ridge
        )
        yield regressor


def _judged(
    equations: _Equations,
    folds: list[tuple[np.ndarray, np.ndarray]],
    sizes: np.ndarray,
    choice: Choice,
) -> list[Choice]:
    """The choice after 0, 1, ... rounds of instruments, with its error of all examples, each not
    seen before.
    """
    count = equations.settings.instrument_rounds
    wrong = np.zeros(1 + count)
    whole = 0.0
    for used, judged in folds:
        rounds = _errors(equations, list(_rounds(equations, used, choice, count)), judged, sizes)
        wrong = wrong + rounds[0]
        whole = whole + rounds[1]
    errors = (wrong / max(whole, 1e-300)).tolist()
    return [replace(choice, error=error, rounds=k) for k, error in enumerate(errors)]


def predicted(regressor: DynamicsRegressor, example: Example) -> Float[np.ndarray, "T D"]:
    """The coefficients of an example's motion, running free from rest."""
    history, drive = regressor.of_person(example.betas)
    return free_run(
        history, np.clip(example.controls, -regressor.limits, regressor.limits) @ drive.T
    )


def _errors(
    equations: _Equations,
    regressors: Sequence[DynamicsRegressor],
    judged: np.ndarray,
    sizes: np.ndarray,
) -> tuple[Float[np.ndarray, " R"], float]:
    """Squared errors of the judged examples by each regressor, and their own squares."""
    wrong = np.zeros(len(regressors))
    whole = 0.0
    for k in np.flatnonzero(judged).tolist():
        example = equations.examples[k]
        whole += float(((example.coefficients * sizes) ** 2).sum())
        for r, regressor in enumerate(regressors):
            wrong[r] += float(
                (((predicted(regressor, example) - example.coefficients) * sizes) ** 2).sum()
            )
    return wrong, whole


def _folds(group: Int[np.ndarray, " N"], max_folds: int) -> list[tuple[np.ndarray, np.ndarray]]:
    """Which examples are learned from and which are judged, in up to ``max_folds`` folds; a
    single group is judged on itself.
    """
    _, number = np.unique(group, return_inverse=True)
    count = min(max_folds, int(number.max()) + 1)
    if count == 1:
        return [(np.ones(len(group), dtype=bool), np.ones(len(group), dtype=bool))]
    return [(number % count != k, number % count == k) for k in range(count)]
