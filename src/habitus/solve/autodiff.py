"""Jacobians and gradients of terms by torch's automatic differentiation; imported only where a term
asks for it.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import Tensor

from habitus.solve.terms import BoundTerm

AT_ONCE = 2**23
"""Numbers that one intermediate tensor of forward differentiation may roughly have: 64 MiB."""


def jacobians(
    term: BoundTerm,
    values: Mapping[str, Tensor],
    names: Sequence[str],
    residual: Any,
    mode: str | None,
    chunk_size: int | None,
) -> dict[str, Tensor]:
    """The Jacobian (R, n) of a term, whose residual is given, with respect to each of `names`.

    mode and chunk_size: as in `habitus.solve.objective.Differentiation`.
    """
    residual = torch.as_tensor(residual).detach()
    count = residual.numel()
    width = sum(values[name].numel() for name in names)
    mode = mode or ("reverse" if 4 * count < width else "forward")
    if mode == "reverse":
        return _row_by_row(term, values, names, residual)
    chunk = chunk_size or max(1, AT_ONCE // max(count, width))
    return {name: _columns(term, values, name, residual, chunk) for name in names}


def cost_and_gradients(
    term: BoundTerm, values: Mapping[str, Tensor], names: Sequence[str]
) -> tuple[float, dict[str, Tensor]]:
    """A term's unweighted cost, and its gradient with respect to each of `names`."""
    leaves = {**values, **{name: values[name].clone().requires_grad_() for name in names}}
    with torch.enable_grad():
        cost = term(leaves).cost
    return float(cost.detach()), _gradients(cost, names, leaves)


def _columns(
    term: BoundTerm, values: Mapping[str, Tensor], name: str, residual: Tensor, chunk: int
) -> Tensor:
    """The block of one unknown by forward differentiation, `chunk` columns at once."""
    here = values[name]
    rows = torch.empty(here.numel(), residual.numel(), dtype=torch.float64, device=residual.device)

    def along(direction: Tensor) -> Tensor:
        return torch.func.jvp(
            lambda value: term({**values, name: value}).value, (here,), (direction,)
        )[1]

    for first in range(0, len(rows), chunk):
        directions = torch.zeros(
            min(chunk, len(rows) - first), here.numel(), dtype=here.dtype, device=here.device
        )
        directions.diagonal(first).fill_(1.0)
        rows[first : first + chunk] = torch.func.vmap(along, randomness="same")(
            directions.view(-1, *here.shape)
        ).detach()
    return rows.T


def _row_by_row(
    term: BoundTerm, values: Mapping[str, Tensor], names: Sequence[str], residual: Tensor
) -> dict[str, Tensor]:
    """All blocks of a term by reverse differentiation, one residual after the other."""
    leaves = {**values, **{name: values[name].detach().requires_grad_() for name in names}}
    blocks = {name: residual.new_zeros(residual.numel(), leaves[name].numel()) for name in names}
    with torch.enable_grad():
        for k, number in enumerate(term(leaves).value):
            for name, part in _gradients(number, names, leaves).items():
                blocks[name][k] = part.reshape(-1)
    return blocks


def _gradients(
    number: Tensor, names: Sequence[str], leaves: Mapping[str, Any]
) -> dict[str, Tensor]:
    """Of one number; nothing where it depends on no unknown."""
    if not (number.requires_grad and names):
        return {}
    inputs = [leaves[name] for name in names]
    parts = torch.autograd.grad(
        number, inputs, retain_graph=True, allow_unused=True, materialize_grads=True
    )
    return dict(zip(names, parts, strict=True))
