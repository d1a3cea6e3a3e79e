"""An objective: weighted terms of the same unknowns, read, checked and evaluated once at the start,
and its gradient and Gauss-Newton matrix, from explicit Jacobians or by autodiff, one term at a
time.

A Jacobian is kept as one block (R, n) for each free unknown that the term takes: an array, a tensor
or scipy.sparse.
"""

from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import scipy.sparse
from jaxtyping import Float

from habitus.errors import HabitusError
from habitus.solve.least_squares import Derivatives, Matrix
from habitus.solve.terms import BoundTerm, Outcome, Unknowns, as_numpy, is_tensor, read_terms


@dataclass(frozen=True, eq=False)
class Objective:
    """Weighted terms of the same unknowns: cost(x) = sum of weight * 1/2 |residual|^2."""

    unknowns: Unknowns
    terms: tuple[BoundTerm, ...]
    _recent: dict[bytes, list[tuple[BoundTerm, Outcome]]] = field(default_factory=dict)

    @classmethod
    def of(
        cls, objective: Any, weights: Mapping[str, float] | None, unknowns: Unknowns
    ) -> "Objective":
        """Terms as in `minimize`, each evaluated once at the start."""
        values = unknowns.values(unknowns.vector)
        terms = []
        outcomes = []
        for term in read_terms(objective, weights or {}, unknowns.names):
            bound = term(values)
            count = 1 if bound.residual.ndim == 0 else len(bound.value)
            terms.append(replace(term, count=count, explicit=bound.explicit, is_cost=bound.is_cost))
            outcomes.append(bound)
        made = cls(unknowns, tuple(terms))
        made._remember(
            unknowns.vector, [pair for pair in zip(terms, outcomes, strict=True) if pair[0].weight]
        )
        return made

    @property
    def active(self) -> tuple[BoundTerm, ...]:
        """The terms of any weight."""
        return tuple(term for term in self.terms if term.weight)

    def evaluate(self, x: Float[np.ndarray, " N"]) -> list[tuple[BoundTerm, Outcome]]:
        """Each active term with what it gives at x; the two latest answers are kept."""
        outcomes = self._recent.get(x.tobytes())
        if outcomes is None:
            values = self.unknowns.values(x)
            outcomes = [(term, term(values)) for term in self.active]
        self._remember(x, outcomes)
        return outcomes

    def _remember(
        self, x: Float[np.ndarray, " N"], outcomes: list[tuple[BoundTerm, Outcome]]
    ) -> None:
        self._recent.pop(x.tobytes(), None)
        self._recent[x.tobytes()] = outcomes
        while len(self._recent) > 2:
            del self._recent[next(iter(self._recent))]

    def costs(self, x: Float[np.ndarray, " N"]) -> dict[str, float]:
        """The weighted cost of each term."""
        costs = {
            term.name: term.weight * float(as_numpy(outcome.cost))
            for term, outcome in self.evaluate(x)
        }
        return {term.name: costs.get(term.name, 0.0) for term in self.terms}

    def free(self, term: BoundTerm) -> tuple[str, ...]:
        """The free unknowns that a term takes."""
        return tuple(name for name in term.takes if name in self.unknowns.start)


def total_cost(outcomes: Collection[tuple[BoundTerm, Outcome]]) -> float:
    """Weighted sum of the costs."""
    return sum(term.weight * float(as_numpy(outcome.cost)) for term, outcome in outcomes)


Block = Any
"""A float64 array, a float64 tensor or a scipy.sparse array, (R, n)."""

MAX_DENSE = 2**28
"""Numbers that a dense Jacobian or matrix may have: 2 GiB."""
CROWDED = 0.05
"""Share of entries from which on a sparse Jacobian multiplies faster as a dense one."""
DENSE = 500
"""Unknowns up to which the Gauss-Newton matrix is dense in any case."""


@dataclass(frozen=True)
class Differentiation:
    """How Jacobians come about where a term gives none.

    mode: "forward" (a column a tangent, `chunk_size` columns at once), "reverse" (a row a pass) or
    None: reverse where the residuals are fewer than a quarter of the unknowns. chunk_size None: as
    many as fit into 64 MiB.
    """

    mode: str | None = None
    chunk_size: int | None = None

    def blocks(
        self, objective: Objective, term: BoundTerm, x: np.ndarray, residual: Any
    ) -> dict[str, Block]:
        """The Jacobian of a term at x, where its residual is as given, by autodiff."""
        values = objective.unknowns.tensors(x)
        from habitus.solve.autodiff import jacobians

        return jacobians(term, values, objective.free(term), residual, self.mode, self.chunk_size)


def too_large(objective: Objective) -> str | None:
    """The name of a term whose dense Jacobian, or its square, would not fit into memory; None where
    all do.
    """
    columns = objective.unknowns.columns
    for term in objective.active:
        width = sum(columns[name].stop - columns[name].start for name in objective.free(term))
        if not term.explicit and max(term.count or 0, width) * width > MAX_DENSE:
            return term.name
    return None


def least_squares_problem(
    objective: Objective, how: Differentiation
) -> Callable[[np.ndarray], tuple[float, Derivatives]]:
    """The objective as the least-squares solvers see it; derivatives cost nothing until they are
    asked for.
    """

    def evaluate(x: np.ndarray) -> tuple[float, Derivatives]:
        outcomes = objective.evaluate(x)
        return total_cost(outcomes), lambda: _normal_equations(objective, how, x, outcomes)

    return evaluate


def cost_and_gradient(
    objective: Objective, x: Float[np.ndarray, " N"]
) -> tuple[float, Float[np.ndarray, " N"]]:
    """By reverse differentiation, term by term; from explicit Jacobians where a term gives them."""
    columns = objective.unknowns.columns
    total = 0.0
    gradient = np.zeros(len(x))
    for term in objective.active:
        outcome = term(objective.unknowns.values(x)) if term.explicit else None
        if outcome is not None and outcome.quadratic is not None:
            cost, (parts, _) = outcome.quadratic.cost, quadratic_parts(objective, term, outcome)
        elif outcome is not None:
            cost, (blocks, residual) = (
                float(as_numpy(outcome.cost)),
                weighted_blocks(objective, term, outcome),
            )
            parts = {name: times(block, residual) for name, block in blocks.items()}
        else:
            tensors = objective.unknowns.tensors(x)
            from habitus.solve.autodiff import cost_and_gradients

            cost, parts = cost_and_gradients(term, tensors, objective.free(term))
        total += term.weight * cost
        for name, part in parts.items():
            gradient[columns[name]] += term.weight * as_numpy(part).ravel()
    return total, gradient


def weighted_blocks(
    objective: Objective,
    term: BoundTerm,
    outcome: Outcome,
    how: Differentiation | None = None,
    x: np.ndarray | None = None,
    crowded: float = CROWDED,
) -> tuple[dict[str, Block], Any]:
    """Jacobian blocks and residual (R,) of a term, both times the roots of its robust weights."""
    if term.explicit:
        blocks = _explicit(objective, term, outcome, crowded)
    else:
        assert how is not None and x is not None
        blocks = how.blocks(objective, term, x, outcome.value)
    root = outcome.root_weights
    residual = outcome.value
    if root is None:
        return blocks, residual
    return {name: _scaled(block, root) for name, block in blocks.items()}, root * residual


def _normal_equations(
    objective: Objective,
    how: Differentiation,
    x: np.ndarray,
    outcomes: list[tuple[BoundTerm, Outcome]],
) -> tuple[np.ndarray, Matrix]:
    """Gradient and matrix; products of blocks are summed, and only one term's Jacobian is alive at
    a time.
    """
    columns = objective.unknowns.columns
    gradient = np.zeros(len(x))
    products: dict[tuple[str, str], Any] = {}

    def add(a: str, b: str, product: Any) -> None:
        products[a, b] = products[a, b] + product if (a, b) in products else product

    for term, outcome in outcomes:
        if outcome.quadratic is not None:
            slopes, curvatures = quadratic_parts(objective, term, outcome)
            for name, slope in slopes.items():
                gradient[columns[name]] += term.weight * slope
            for (a, b), block in curvatures.items():
                whole = term.weight * _written_out(block, columns[a], columns[b])
                in_order = columns[a].start <= columns[b].start
                add(*((a, b, whole) if in_order else (b, a, whole.T)))
            continue
        blocks, residual = weighted_blocks(objective, term, outcome, how, x)
        blocks = {name: blocks[name] for name in columns if name in blocks}
        for k, (name, block) in enumerate(blocks.items()):
            gradient[columns[name]] += term.weight * times(block, residual)
            for other in list(blocks)[k:]:
                add(name, other, term.weight * _product(block, blocks[other]))
    return gradient, _matrix(columns, products)


def quadratic_parts(
    objective: Objective, term: BoundTerm, outcome: Outcome
) -> tuple[dict[str, Float[np.ndarray, " n"]], dict[tuple[str, str], Any]]:
    """Gradients (n,) and matrix blocks of a term's normal equations for the free unknowns,
    checked.
    """
    assert outcome.quadratic is not None
    gradients, blocks = outcome.quadratic.derivatives()
    free = objective.free(term)
    columns = objective.unknowns.columns
    if not set(free) <= set(gradients):
        raise HabitusError(
            f"the term {term.name!r} gives gradients of {', '.join(map(repr, gradients))}; "
            f"expected each unknown it takes: {', '.join(map(repr, term.takes))}"
        )
    slopes = {}
    for name in free:
        width = columns[name].stop - columns[name].start
        slopes[name] = as_numpy(gradients[name]).ravel()
        if len(slopes[name]) != width:
            raise HabitusError(
                f"the term {term.name!r} gives {len(slopes[name])} numbers as gradient to "
                f"{name!r}; expected {width}"
            )
    curvatures = {}
    for (a, b), block in blocks.items():
        if a in free and b in free:
            if a != b and (b, a) in blocks:
                raise HabitusError(
                    f"the term {term.name!r} gives the matrix block of {a!r} and {b!r} twice"
                )
            curvatures[a, b] = block if scipy.sparse.issparse(block) else as_numpy(block)
            sizes = (columns[name].stop - columns[name].start for name in (a, b))
            _check_block(term.name, (a, b), curvatures[a, b].shape, *sizes)
    return slopes, curvatures


def _check_block(
    term: str, pair: tuple[str, str], shape: tuple[int, ...], rows: int, width: int
) -> None:
    """HabitusError for a block of normal equations whose shape is none of those of `Quadratic`."""
    fits = shape == (rows, width)
    if len(shape) == 3:
        fits = shape[0] * shape[1] == rows and width in (shape[2], shape[0] * shape[2])
    if not fits:
        raise HabitusError(
            f"the matrix block of the term {term!r} for {pair[0]!r} and {pair[1]!r} has shape "
            f"{shape}; expected ({rows}, {width}), or (T, n, m) for unknowns of T entries"
        )


def _written_out(block: Any, rows: slice, columns: slice) -> Any:
    """A block of a `Quadratic` as a matrix (rows, columns), sparse where its entries do not
    meet.
    """
    if block.ndim == 2:
        return block
    count, height, width = block.shape
    if columns.stop - columns.start == width:
        return block.reshape(count * height, width)
    places = (np.arange(count), np.arange(count + 1))
    return scipy.sparse.bsr_array((block, *places), shape=(count * height, count * width)).tocsr()


def _matrix(columns: dict[str, slice], products: dict[tuple[str, str], Any]) -> Matrix:
    """The symmetric matrix of products (n_a, n_b), a before b: sparse where one is and the unknowns
    are many.
    """
    size = max(where.stop for where in columns.values())
    if size > DENSE and any(scipy.sparse.issparse(product) for product in products.values()):
        upper = scipy.sparse.csc_array((size, size))
        for (a, b), product in products.items():
            part = scipy.sparse.coo_array(product)
            places = (part.row + columns[a].start, part.col + columns[b].start)
            half = scipy.sparse.coo_array((part.data, places), shape=(size, size))
            upper = upper + half if a == b else upper + half + half.T
        return upper.tocsc()
    matrix = np.zeros((size, size))
    for (a, b), product in products.items():
        matrix[columns[a], columns[b]] = (
            product.toarray() if scipy.sparse.issparse(product) else product
        )
        matrix[columns[b], columns[a]] = matrix[columns[a], columns[b]].T
    return matrix


def _explicit(
    objective: Objective, term: BoundTerm, outcome: Outcome, crowded: float
) -> dict[str, Block]:
    """The Jacobians that a term gave to its free unknowns, checked."""
    given = outcome.jacobians() if callable(outcome.jacobians) else outcome.jacobians
    free = objective.free(term)
    if not isinstance(given, Mapping) or not set(free) <= set(given) <= set(term.takes):
        names = (
            ", ".join(map(repr, given))
            if isinstance(given, Mapping)
            else f"a {type(given).__name__}"
        )
        raise HabitusError(
            f"the term {term.name!r} gives Jacobians of {names}; expected a mapping with each "
            "unknown it takes: "
            f"{', '.join(map(repr, term.takes))}"
        )
    columns = objective.unknowns.columns
    widths = {name: columns[name].stop - columns[name].start for name in free}
    return {name: _block(term, name, given[name], widths[name], crowded) for name in free}


def _block(term: BoundTerm, name: str, given: Any, width: int, crowded: float) -> Block:
    """Dense (R, width), or sparse where few enough entries are not zero."""
    rows = term.count or 0
    sparse = scipy.sparse.issparse(given)
    if not sparse:
        given = given.detach().double() if is_tensor(given) else np.asarray(given, dtype=float)
    shape = tuple(given.shape)
    splits = any(
        np.prod(shape[:k]) == rows and np.prod(shape[k:]) == width for k in range(len(shape) + 1)
    )
    if not splits or (sparse and shape != (rows, width)):
        raise HabitusError(
            f"the Jacobian of the term {term.name!r} to {name!r} has shape {shape}; expected "
            f"({rows}, {width}), "
            f"or the axes of the residual and then those of {name!r}"
        )
    if not sparse:
        return given.reshape(rows, width)
    if crowded * rows * width < given.nnz and rows * width <= MAX_DENSE:
        return np.asarray(given.toarray(), dtype=float)
    return given if given.format in ("csr", "bsr") else scipy.sparse.csr_array(given, dtype=float)


def _scaled(block: Block, rows: Any) -> Block:
    """The block with its rows multiplied."""
    if scipy.sparse.issparse(block):
        of_row = scipy.sparse.bsr_array if block.format == "bsr" else scipy.sparse.csr_array
        height = block.blocksize[0] if block.format == "bsr" else 1
        factors = np.repeat(as_numpy(rows).reshape(-1, height), np.diff(block.indptr), axis=0)
        data = (
            factors[:, :, None] * block.data
            if block.format == "bsr"
            else factors[:, 0] * block.data
        )
        return of_row((data, block.indices, block.indptr), shape=block.shape)
    rows = as_numpy(rows) if isinstance(block, np.ndarray) else block.new_tensor(as_numpy(rows))
    return rows[:, None] * block


def _product(a: Block, b: Block) -> Any:
    """a^T b, sparse where both are."""
    if is_tensor(a) and is_tensor(b):
        return as_numpy(a.T @ b)
    a, b = (as_numpy(each) if is_tensor(each) else each for each in (a, b))
    return a.T @ b


def times(block: Block, residual: Any) -> np.ndarray:
    """J^T r."""
    if is_tensor(block) and is_tensor(residual):
        return as_numpy(block.T @ residual.detach())
    block = as_numpy(block) if is_tensor(block) else block
    return block.T @ as_numpy(residual)
