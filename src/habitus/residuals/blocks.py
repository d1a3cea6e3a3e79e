"""Residual blocks: an unsquared vector, its weight, and its derivatives with respect to slices of the unknowns."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Block:
    """One term of the objective, ``½ weight ‖residual‖²``, linearised.

    residual: (n,). jacobian: pairs of a slice of the unknowns (k wide) and an (n, k) matrix.
    """

    name: str
    weight: float
    residual: Array
    jacobian: Sequence[tuple[slice, Array]]

    @property
    def cost(self) -> float:
        """½ weight ‖residual‖²."""
        return 0.5 * self.weight * float(self.residual @ self.residual)


def normal_equations(blocks: Iterable[Block], size: int) -> tuple[float, Array, Array]:
    """Cost, gradient (size,) and Gauss-Newton matrix (size, size) of a sum of blocks."""
    cost, gradient, matrix = 0.0, np.zeros(size), np.zeros((size, size))
    for block in blocks:
        cost += block.cost
        for columns, derivative in block.jacobian:
            gradient[columns] += block.weight * (block.residual @ derivative)
            for others, other in block.jacobian:
                matrix[columns, others] += block.weight * (derivative.T @ other)
    return cost, gradient, matrix


def costs_by_name(blocks: Iterable[Block]) -> dict[str, float]:
    """The cost of each named term."""
    costs: dict[str, float] = {}
    for block in blocks:
        costs[block.name] = costs.get(block.name, 0.0) + block.cost
    return costs
