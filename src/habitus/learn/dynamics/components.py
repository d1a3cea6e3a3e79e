"""Principal directions of more surfaces than memory holds, in one pass, and every surface's
coefficients (S 6: PCA).
"""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from habitus.errors import HabitusError


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
    coefficients: list[Float[np.ndarray, "n k"]]
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
    blocks: Iterable[Float[np.ndarray, "n M"]],
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
        for one in np.unique(group[group >= 0]):
            table[group == one] -= table[group == one].mean(0)
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
