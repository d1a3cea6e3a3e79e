"""Arrow form of terms: some unknowns shared by all, others in F blocks (`habitus.solve.arrow`).

A Jacobian to a blocked unknown (F, ...) is fastest as a scipy.sparse.bsr_array of F blocks on its
diagonal, the residuals of one block after those of another; dense and other sparse ones do as well.
Jacobians to shared unknowns may be dense or sparse.
"""

from collections.abc import Callable, Collection
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.sparse
from jaxtyping import Float, Int

from habitus.errors import HabitusError
from habitus.solve.arrow import ArrowMatrix
from habitus.solve.least_squares import Derivatives
from habitus.solve.objective import (
    Differentiation,
    Objective,
    quadratic_parts,
    times,
    total_cost,
    weighted_blocks,
)
from habitus.solve.terms import BoundTerm, as_numpy, is_tensor


@dataclass(frozen=True)
class _Layout:
    """Places in an arrow: of each shared unknown its rows, of each blocked one its rows within a
    block.
    """

    shared: dict[str, slice]
    blocked: dict[str, slice]
    count: int
    order: Int[np.ndarray, " n"]

    @property
    def size(self) -> tuple[int, int]:
        """Shared unknowns G, and unknowns N of a block."""
        return _end(self.shared), _end(self.blocked)

    def width(self, name: str) -> int:
        """Numbers of an unknown: all of a shared one, one entry's of a blocked one."""
        where = self.shared[name] if name in self.shared else self.blocked[name]
        return where.stop - where.start


def arrow_problem(
    objective: Objective, how: Differentiation, blocked: Collection[str]
) -> Callable[[np.ndarray], tuple[float, Derivatives]]:
    """The objective with an `ArrowMatrix` for its Gauss-Newton matrix; derivatives are made when
    asked for.

    blocked: names of free unknowns (F, ...), all of the same F. Raises HabitusError where that is
    not so, and where a residual depends on two blocks.
    """
    layout = _layout(objective, blocked)

    def evaluate(x: np.ndarray) -> tuple[float, Derivatives]:
        outcomes = objective.evaluate(x)
        return total_cost(outcomes), lambda: _normal_equations(objective, how, layout, x, outcomes)

    return evaluate


def _layout(objective: Objective, blocked: Collection[str]) -> _Layout:
    start = objective.unknowns.start
    columns = objective.unknowns.columns
    counts = {len(start[name]) if name in start and np.ndim(start[name]) else 0 for name in blocked}
    if len(counts) != 1 or 0 in counts:
        raise HabitusError(
            f"blocks are {', '.join(map(repr, blocked))}; expected free unknowns of the same "
            "first axis"
        )
    count = counts.pop()
    shared = {}
    inner = {}
    order = []
    within = []
    for name, where in columns.items():
        numbers = np.arange(where.start, where.stop)
        places, width = (
            (inner, len(numbers) // count) if name in blocked else (shared, len(numbers))
        )
        places[name] = slice(_end(places), _end(places) + width)
        (within if name in blocked else order).append(
            numbers.reshape(count, -1) if name in blocked else numbers
        )
    return _Layout(
        shared, inner, count, np.concatenate([*order, np.concatenate(within, axis=1).ravel()])
    )


def _end(places: dict[str, slice]) -> int:
    return max((where.stop for where in places.values()), default=0)


def _normal_equations(
    objective: Objective, how: Differentiation, layout: _Layout, x: np.ndarray, outcomes: list
) -> tuple[Float[np.ndarray, " n"], ArrowMatrix]:
    (head, width), count = layout.size, layout.count
    shared = np.zeros((head, head))
    border = np.zeros((count, width, head))
    blocks = np.zeros((count, width, width))
    gradient = np.zeros(len(x))
    arrow = ArrowMatrix(shared, border, blocks, layout.order)
    for term, outcome in outcomes:
        if outcome.quadratic is not None:
            slopes, curvatures = quadratic_parts(objective, term, outcome)
            for name, slope in slopes.items():
                gradient[objective.unknowns.columns[name]] += term.weight * slope
            for pair, block in curvatures.items():
                _add_block(arrow, layout, term, pair, block)
            continue
        jacobian, residual = weighted_blocks(objective, term, outcome, how, x, crowded=np.inf)
        jacobian = {
            name: as_numpy(block) if is_tensor(block) else block for name, block in jacobian.items()
        }
        for name, block in jacobian.items():
            gradient[objective.unknowns.columns[name]] += term.weight * times(block, residual)
        common = {name: block for name, block in jacobian.items() if name in layout.shared}
        names = list(common)
        for k, name in enumerate(names):
            for other in names[k:]:
                dense = term.weight * _product(common[name], common[other])
                shared[layout.shared[name], layout.shared[other]] += dense
                if other != name:
                    shared[layout.shared[other], layout.shared[name]] += dense.T
        own = {name: block for name, block in jacobian.items() if name in layout.blocked}
        if own:
            table, split = _by_block(term.name, own, layout)
            blocks += term.weight * (table.transpose(0, 2, 1) @ table)
            for name, block in common.items():
                border[:, :, layout.shared[name]] += term.weight * _meeting(table, block, split)
    return gradient, arrow


def _add_block(
    arrow: ArrowMatrix, layout: _Layout, term: BoundTerm, pair: tuple[str, str], block: Any
) -> None:
    """Add one block of a term's `Quadratic`, as the pair of unknowns it is of."""
    first, second = pair
    both = first in layout.blocked and second in layout.blocked
    mixed = first in layout.blocked and second in layout.shared
    width = layout.width(second)
    if (both or mixed) and block.shape != (layout.count, layout.width(first), width):
        raise HabitusError(
            f"the matrix block of the term {term.name!r} for {first!r} and {second!r} has shape "
            f"{block.shape}; with `blocks` expected "
            f"({layout.count}, {layout.width(first)}, {width})"
        )
    if first in layout.shared and (second in layout.blocked or block.ndim != 2):
        raise HabitusError(
            f"the matrix block of the term {term.name!r} for {first!r} and {second!r} names the "
            "shared unknown first; with `blocks` expected the one of several entries first"
        )
    block = term.weight * (block.toarray() if scipy.sparse.issparse(block) else block)
    if both:
        rows, columns = layout.blocked[first], layout.blocked[second]
        arrow.blocks[:, rows, columns] += block
        if first != second:
            arrow.blocks[:, columns, rows] += block.transpose(0, 2, 1)
    elif mixed:
        arrow.border[:, layout.blocked[first], layout.shared[second]] += block
    else:
        rows, columns = layout.shared[first], layout.shared[second]
        arrow.shared[rows, columns] += block
        if first != second:
            arrow.shared[columns, rows] += block.T


def _by_block(
    name: str, own: dict[str, Any], layout: _Layout
) -> tuple[Float[np.ndarray, "F R N"], bool]:
    """Jacobians of one block each, and whether residuals are split among the blocks too (else all
    are in each).
    """
    split = all(_on_diagonal(block, layout.count) for block in own.values())
    rows = next(iter(own.values())).shape[0] // (layout.count if split else 1)
    table = np.zeros((layout.count, rows, layout.size[1]))
    for unknown, block in own.items():
        if split:
            table[:, :, layout.blocked[unknown]] = block.data
        else:
            dense = np.asarray(block.toarray() if scipy.sparse.issparse(block) else block)
            table[:, :, layout.blocked[unknown]] = dense.reshape(rows, layout.count, -1).transpose(
                1, 0, 2
            )
    if not split and np.any(np.sum(np.any(table != 0.0, axis=2), axis=0) > 1):
        raise HabitusError(
            f"a residual of the term {name!r} depends on two blocks; leave `blocks` out for such "
            "terms"
        )
    return table, split


def _on_diagonal(block: Any, count: int) -> bool:
    """Whether a Jacobian is a bsr_array of `count` blocks on its diagonal."""
    return (
        scipy.sparse.issparse(block)
        and block.format == "bsr"
        and len(block.indices) == count == len(block.indptr) - 1
        and np.array_equal(block.indices, np.arange(count))
        and block.shape == (count * block.blocksize[0], count * block.blocksize[1])
    )


def _product(first: Any, second: Any) -> Float[np.ndarray, "g h"]:
    """first^T second, dense."""
    parts = _one_a_row(second)
    if parts is not None and not scipy.sparse.issparse(first):
        data, column = parts
        count, rows, width = data.shape
        products = first.reshape(count, rows, -1).transpose(0, 2, 1) @ data
        member = (np.arange(second.shape[1] // width)[:, None] == column).astype(float)
        added = (member @ products.reshape(count, -1)).reshape(-1, *products.shape[1:])
        return added.transpose(1, 0, 2).reshape(first.shape[1], -1)
    product = first.T @ second
    return product.toarray() if scipy.sparse.issparse(product) else product


def _one_a_row(
    block: Any,
) -> tuple[Float[np.ndarray, "K r c"], Int[np.ndarray, " K"]] | None:
    """Blocks and block columns of a bsr_array with one block in each row of blocks; else None.

    Products of these are a few dense ones: scipy.sparse takes ten times as long to look at them.
    """
    if not scipy.sparse.issparse(block) or block.format != "bsr":
        return None
    single = np.array_equal(block.indptr, np.arange(len(block.indptr)))
    return (block.data, block.indices) if single else None


def _meeting(
    table: Float[np.ndarray, "F R N"], block: Any, split: bool
) -> Float[np.ndarray, "F N g"]:
    """Products of blocks' Jacobians with a shared unknown's (all residuals, g)."""
    count, rows, _ = table.shape
    if not scipy.sparse.issparse(block):
        return table.transpose(0, 2, 1) @ (block.reshape(count, rows, -1) if split else block)
    parts = _one_a_row(block)
    if split and parts is not None and rows % parts[0].shape[1] == 0:
        data, column = parts[0], parts[1].reshape(count, -1)
        _, height, width = data.shape
        if np.all(np.diff(np.sort(column, axis=1), axis=1) > 0):  # no column twice in one of ours
            own = table.reshape(count, -1, height, table.shape[2]).transpose(0, 1, 3, 2)
            met = np.zeros((count, block.shape[1] // width, table.shape[2], width))
            met[np.arange(count)[:, None], column] = own @ data.reshape(
                *column.shape, height, width
            )
            return met.transpose(0, 2, 1, 3).reshape(count, table.shape[2], -1)
    transposed = block.T.tocsc()
    ends = [slice(k * rows, (k + 1) * rows) if split else slice(None) for k in range(count)]
    return np.stack(
        [(transposed[:, where] @ part).T for where, part in zip(ends, table, strict=True)]
    )
