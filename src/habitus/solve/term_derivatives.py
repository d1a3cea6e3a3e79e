"""Gradients and Gauss-Newton matrices of named terms: by autodiff or from explicit Jacobians, one term at a time.

A Jacobian is kept as one block (R, n) for each unknown that the term takes: a float64 tensor, or scipy sparse.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.sparse
import torch
from jaxtyping import Float
from torch import Tensor

from habitus.errors import HabitusError
from habitus.solve.least_squares import Derivatives, Matrix
from habitus.solve.terms import Objective, Outcome, Term

Block = Any
"""A float64 tensor or a scipy csr_array, (R, n)."""

MOST = 2**28
"""Numbers that a dense Jacobian or matrix may have: 2 GiB."""
AT_ONCE = 2**23
"""Numbers that one intermediate tensor of forward differentiation may roughly have: 64 MiB."""
CROWDED = 0.05
"""Share of entries from which on a sparse Jacobian multiplies faster as a dense one."""
DENSE = 500
"""Unknowns up to which the Gauss-Newton matrix is dense in any case."""


@dataclass(frozen=True)
class Differentiation:
    """How Jacobians come about where a term gives none.

    mode: "forward" (a column a tangent, `chunk_size` columns at once), "reverse" (a row a pass) or None: reverse where
    the residuals are fewer than a quarter of the unknowns. chunk_size None: as many as keep to `AT_ONCE`.
    """

    mode: str | None = None
    chunk_size: int | None = None

    def blocks(self, term: Term, values: Mapping[str, Tensor], residual: Tensor) -> dict[str, Tensor]:
        """The Jacobian of a term with this residual (R,)."""
        count = residual.numel()
        width = sum(values[name].numel() for name in term.takes)
        mode = self.mode or ("reverse" if 4 * count < width else "forward")
        if mode == "reverse":
            return _row_by_row(term, values, residual)
        chunk = self.chunk_size or max(1, AT_ONCE // max(count, width))
        return {name: _columns(term, values, name, residual, chunk) for name in term.takes}


def too_large(objective: Objective) -> str | None:
    """The name of a term whose dense Jacobian, or its square, would not fit into memory; None where all do."""
    for term in objective.active:
        width = sum(objective.unknowns.start[name].numel() for name in term.takes)
        if not term.explicit and max(term.count or 0, width) * width > MOST:
            return term.name
    return None


def least_squares_problem(
    objective: Objective, how: Differentiation
) -> Callable[[np.ndarray], tuple[float, Derivatives]]:
    """The objective as the least-squares solvers see it; derivatives cost nothing until they are asked for."""

    def evaluate(x: np.ndarray) -> tuple[float, Derivatives]:
        values = objective.unknowns.tensors(x)
        found = [(term, term(values)) for term in objective.active]
        cost = sum(term.weight * float(outcome.cost.detach()) for term, outcome in found)
        return cost, lambda: _normal_equations(objective, how, values, found)

    return evaluate


def cost_and_gradient(objective: Objective, x: Float[np.ndarray, " N"]) -> tuple[float, Float[np.ndarray, " N"]]:
    """By reverse differentiation, term by term; from explicit Jacobians where a term gives them."""
    columns, total, gradient = objective.unknowns.columns, 0.0, np.zeros(len(x))
    values = objective.unknowns.tensors(x)
    leaves = {name: value.clone().requires_grad_() for name, value in values.items()}
    for term in objective.active:
        with torch.enable_grad():
            outcome = term(values if term.explicit else leaves)
            cost = outcome.cost
        if term.explicit:
            parts = {name: _times(block, outcome.value) for name, block in _explicit(term, values, outcome).items()}
        else:
            parts = {name: _numpy(part).ravel() for name, part in _gradients(cost, term, leaves).items()}
        total += term.weight * float(cost.detach())
        for name, part in parts.items():
            gradient[columns[name]] += term.weight * part
    return total, gradient


def _normal_equations(
    objective: Objective, how: Differentiation, values: dict[str, Tensor], found: list[tuple[Term, Outcome]]
) -> tuple[np.ndarray, Matrix]:
    """Gradient and matrix; products of blocks are summed, and only one term's Jacobian is alive at a time."""
    columns = objective.unknowns.columns
    gradient = np.zeros(sum(value.numel() for value in values.values()))
    products: dict[tuple[str, str], Any] = {}
    for term, outcome in found:
        blocks = _explicit(term, values, outcome) if term.explicit else how.blocks(term, values, outcome.value)
        for k, (name, block) in enumerate(blocks.items()):
            gradient[columns[name]] += term.weight * _times(block, outcome.value)
            for other in list(blocks)[k:]:
                product = term.weight * _product(block, blocks[other])
                pair = (name, other)
                products[pair] = products[pair] + product if pair in products else product
    return gradient, _matrix(columns, products)


def _matrix(columns: dict[str, slice], products: dict[tuple[str, str], Any]) -> Matrix:
    """The symmetric matrix of products (n_a, n_b), a before b: sparse where one is and the unknowns are many."""
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
        matrix[columns[a], columns[b]] = product.toarray() if scipy.sparse.issparse(product) else product
        matrix[columns[b], columns[a]] = matrix[columns[a], columns[b]].T
    return matrix


def _columns(term: Term, values: Mapping[str, Tensor], name: str, residual: Tensor, chunk: int) -> Tensor:
    """The block of one unknown by forward differentiation, `chunk` columns at once."""
    here = values[name]
    rows = torch.empty(here.numel(), residual.numel(), dtype=torch.float64, device=residual.device)

    def along(direction: Tensor) -> Tensor:
        return torch.func.jvp(lambda value: term({**values, name: value}).value, (here,), (direction,))[1]

    for first in range(0, len(rows), chunk):
        directions = torch.zeros(min(chunk, len(rows) - first), here.numel(), dtype=here.dtype, device=here.device)
        directions.diagonal(first).fill_(1.0)
        rows[first : first + chunk] = torch.func.vmap(along, randomness="same")(
            directions.view(-1, *here.shape)
        ).detach()
    return rows.T


def _row_by_row(term: Term, values: Mapping[str, Tensor], residual: Tensor) -> dict[str, Tensor]:
    """All blocks of a term by reverse differentiation, one residual after the other."""
    leaves = {name: values[name].detach().requires_grad_() for name in term.takes}
    blocks = {name: residual.new_zeros(residual.numel(), leaf.numel()) for name, leaf in leaves.items()}
    with torch.enable_grad():
        for k, number in enumerate(term(leaves).value):
            for name, part in _gradients(number, term, leaves).items():
                blocks[name][k] = part.reshape(-1)
    return blocks


def _gradients(number: Tensor, term: Term, leaves: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Of one number; nothing where it depends on no unknown."""
    if not (number.requires_grad and term.takes):
        return {}
    inputs = [leaves[name] for name in term.takes]
    parts = torch.autograd.grad(number, inputs, retain_graph=True, allow_unused=True, materialize_grads=True)
    return dict(zip(term.takes, parts, strict=True))


def _explicit(term: Term, values: Mapping[str, Tensor], outcome: Outcome) -> dict[str, Block]:
    """The Jacobians that a term gave, checked."""
    given = outcome.jacobians() if callable(outcome.jacobians) else outcome.jacobians
    if not isinstance(given, Mapping) or set(given) != set(term.takes):
        names = ", ".join(map(repr, given)) if isinstance(given, Mapping) else f"a {type(given).__name__}"
        raise HabitusError(
            f"the term {term.name!r} gives Jacobians of {names}; expected a mapping with each unknown it takes: "
            f"{', '.join(map(repr, term.takes))}"
        )
    return {name: _block(term.name, name, given[name], outcome.value, values[name]) for name in term.takes}


def _block(term: str, name: str, given: Any, residual: Tensor, unknown: Tensor) -> Block:
    rows, width = residual.numel(), unknown.numel()
    if scipy.sparse.issparse(given):
        fits = given.shape == (rows, width)
    else:
        given = torch.as_tensor(given, dtype=torch.float64, device=residual.device).detach()
        fits = given.numel() == rows * width
    if not fits:
        raise HabitusError(
            f"the Jacobian of the term {term!r} to {name!r} has shape {tuple(given.shape)}; expected ({rows}, {width})"
        )
    if not scipy.sparse.issparse(given):
        return given.reshape(rows, width)
    if CROWDED * rows * width < given.nnz and rows * width <= MOST:
        return torch.as_tensor(given.toarray(), dtype=torch.float64, device=residual.device)
    return scipy.sparse.csr_array(given, dtype=float)


def _product(a: Block, b: Block) -> Any:
    """a^T b, sparse where both are."""
    if isinstance(a, Tensor) and isinstance(b, Tensor):
        return _numpy(a.T @ b)
    a, b = (_numpy(each) if isinstance(each, Tensor) else each for each in (a, b))
    return a.T @ b


def _times(block: Block, residual: Tensor) -> np.ndarray:
    """J^T r."""
    residual = residual.detach()
    return _numpy(block.T @ residual) if isinstance(block, Tensor) else block.T @ _numpy(residual)


def _numpy(tensor: Tensor) -> np.ndarray:
    return tensor.detach().cpu().numpy()
