"""Normal equations of residual blocks, in the form that the shape stage's unknowns give them."""

from collections.abc import Iterable

import numpy as np

from habitus.residuals.blocks import Array, Block
from habitus.solve.arrow import ArrowMatrix


def arrow_equations(blocks: Iterable[Block], shared: int, count: int, width: int) -> tuple[float, Array, ArrowMatrix]:
    """Cost, gradient and Gauss-Newton matrix of a sum of blocks.

    Unknowns are ``shared`` ones, then ``count`` groups of ``width``; no block touches two groups.
    """
    matrix = ArrowMatrix(np.zeros((shared, shared)), np.zeros((count, width, shared)), np.zeros((count, width, width)))
    cost, gradient = 0.0, np.zeros(shared + count * width)
    for block in blocks:
        cost += block.cost
        for columns, derivative in block.jacobian:
            gradient[columns] += block.weight * (block.residual @ derivative)
            for others, other in block.jacobian:
                target = _entries(matrix, columns, others, shared, width)
                if target is not None:
                    target += block.weight * (derivative.T @ other)
    return cost, gradient, matrix


def _entries(matrix: ArrowMatrix, rows: slice, columns: slice, shared: int, width: int) -> Array | None:
    """The part of an arrow matrix at these rows and columns, None for the half that symmetry stores elsewhere."""
    if rows.start < shared:
        return matrix.shared[rows, columns] if columns.start < shared else None
    group, first = divmod(rows.start - shared, width)
    inside = slice(first, first + rows.stop - rows.start)
    if columns.start < shared:
        return matrix.border[group, inside, columns]
    first = columns.start - shared - group * width
    return matrix.blocks[group, inside, first : first + columns.stop - columns.start]
