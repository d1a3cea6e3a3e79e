"""Named residual terms of named unknowns: what `minimize` is given, read and checked."""

import inspect
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from habitus.errors import HabitusError

Jacobians = Mapping[str, Any]
"""Of each unknown a term takes: numpy array, tensor or scipy sparse, (numbers of the residual, of the unknown)."""


@dataclass(frozen=True, eq=False)
class Unknowns:
    """Named tensors of any shape, dtype and device, and the vector x (N,) of all their numbers in float64."""

    start: dict[str, Tensor]

    @classmethod
    def of(cls, free: Mapping[str, Tensor]) -> "Unknowns":
        """Checked; HabitusError where there is nothing to move or something that is no floating tensor."""
        if not isinstance(free, Mapping):
            raise HabitusError(f"free is a {type(free).__name__}; expected a mapping of names to start tensors")
        for name, tensor in free.items():
            if not isinstance(tensor, Tensor) or not tensor.dtype.is_floating_point:
                kind = f"a tensor of {tensor.dtype}" if isinstance(tensor, Tensor) else f"a {type(tensor).__name__}"
                raise HabitusError(f"the free {name!r} is {kind}; expected a floating tensor: tensor.double()")
        if not sum(tensor.numel() for tensor in free.values()):
            raise HabitusError(
                "no number is free; expected a mapping of names to start tensors, as {'shift': zeros(3)}"
            )
        return cls({name: tensor.detach().clone() for name, tensor in free.items()})

    @property
    def columns(self) -> dict[str, slice]:
        """Where each tensor's numbers lie in x."""
        ends = np.cumsum([tensor.numel() for tensor in self.start.values()]).tolist()
        return {name: slice(end - self.start[name].numel(), end) for name, end in zip(self.start, ends, strict=True)}

    @property
    def vector(self) -> Float[np.ndarray, " N"]:
        """The start as x."""
        return np.concatenate([tensor.double().cpu().numpy().ravel() for tensor in self.start.values()])

    def tensors(self, x: Float[np.ndarray, " N"]) -> dict[str, Tensor]:
        """float64 tensors in the start's shapes, where the start's lie."""
        parts = ((self.start[name], x[where]) for name, where in self.columns.items())
        values = (torch.tensor(part, dtype=torch.float64, device=like.device).view(like.shape) for like, part in parts)
        return dict(zip(self.start, values, strict=True))

    def like_start(self, x: Float[np.ndarray, " N"]) -> dict[str, Tensor]:
        """The same in the start's dtypes."""
        return {name: value.to(self.start[name].dtype) for name, value in self.tensors(x).items()}


@dataclass(frozen=True, eq=False)
class Outcome:
    """What a term gave, in float64: residual (R,), or a cost of no axes; perhaps Jacobians, or what gives them."""

    value: Tensor
    jacobians: Jacobians | Callable[[], Jacobians] | None = None

    @property
    def cost(self) -> Tensor:
        """1/2 |r|^2; a number without axes is a cost itself."""
        return self.value if self.value.ndim == 0 else 0.5 * (self.value @ self.value)


@dataclass(frozen=True)
class Term:
    """A function of some of the unknowns, `takes`, and its weight.

    What the start has shown: the number of its residuals, whether it gives Jacobians, whether it is a cost already.
    """

    name: str
    function: Callable[..., Any]
    weight: float
    takes: tuple[str, ...]
    count: int | None = None
    explicit: bool = False
    is_cost: bool = False

    def __call__(self, values: Mapping[str, Tensor]) -> Outcome:
        """The term at these values; HabitusError for anything but floating tensors, always as many numbers."""
        given = self.function(**{name: values[name] for name in self.takes})
        value: Any = given
        jacobians = None
        if isinstance(given, tuple) and len(given) == 2:
            value, jacobians = given
        if isinstance(value, np.ndarray):
            value = torch.from_numpy(np.ascontiguousarray(value))
        if not isinstance(value, Tensor) or not value.dtype.is_floating_point:
            kind = f"a tensor of {value.dtype}" if isinstance(value, Tensor) else f"a {type(value).__name__}"
            raise HabitusError(f"the term {self.name!r} gives {kind}; expected a floating tensor of residuals")
        if self.count not in (None, value.numel()):
            raise HabitusError(
                f"the term {self.name!r} gave {self.count} residuals at the start and {value.numel()} later; "
                "keep their number, for example by multiplying with a mask"
            )
        if not value.numel():
            raise HabitusError(f"the term {self.name!r} gives no residuals; expected at least one")
        return Outcome((value.reshape(-1) if value.ndim else value).double(), jacobians)

    def tried(self, values: Mapping[str, Tensor]) -> "Term":
        """The same term, knowing what it gives."""
        found = self(values)
        explicit = found.jacobians is not None
        return replace(self, count=found.value.numel(), explicit=explicit, is_cost=found.value.ndim == 0)


@dataclass(frozen=True, eq=False)
class Objective:
    """Weighted terms of the same unknowns: cost(x) = sum of weight * 1/2 |residual|^2."""

    unknowns: Unknowns
    terms: tuple[Term, ...]

    @classmethod
    def of(cls, objective: Any, weights: Mapping[str, float] | None, unknowns: Unknowns) -> "Objective":
        """Read, checked and evaluated once at the start."""
        values = unknowns.tensors(unknowns.vector)
        terms = read_terms(objective, weights or {}, tuple(unknowns.start))
        return cls(unknowns, tuple(term.tried(values) for term in terms))

    @property
    def active(self) -> tuple[Term, ...]:
        """The terms of any weight."""
        return tuple(term for term in self.terms if term.weight)

    def costs(self, x: Float[np.ndarray, " N"]) -> dict[str, float]:
        """The weighted cost of each term."""
        values = self.unknowns.tensors(x)
        return {
            term.name: term.weight * float(term(values).cost.detach()) if term.weight else 0.0 for term in self.terms
        }


def read_terms(objective: Any, weights: Mapping[str, float], names: tuple[str, ...]) -> Iterator[Term]:
    """Terms of a mapping of functions, or of one function, which is then named "objective"."""
    functions = objective if isinstance(objective, Mapping) else {"objective": objective}
    if not functions:
        raise HabitusError("the objective has no terms; expected a function or a mapping of names to functions")
    for name, weight in weights.items():
        if name not in functions:
            raise HabitusError(f"a weight is named {name!r}; the terms are {', '.join(map(repr, functions))}")
        if not 0.0 <= float(weight) < np.inf:
            raise HabitusError(f"the weight of {name!r} is {weight}; expected a finite number of 0 or more")
    for name, function in functions.items():
        yield Term(name, function, float(weights.get(name, 1.0)), _takes(name, function, names))


def _takes(name: str, function: Any, names: tuple[str, ...]) -> tuple[str, ...]:
    """The unknowns among a function's parameters; all of them where it takes any keyword or does not tell."""
    if not callable(function):
        raise HabitusError(f"the term {name!r} is a {type(function).__name__}; expected a function of the free values")
    try:
        parameters = inspect.signature(function).parameters.values()
    except (TypeError, ValueError):
        return names
    named = {each.name for each in parameters if each.kind in (each.POSITIONAL_OR_KEYWORD, each.KEYWORD_ONLY)}
    loose = {each.name for each in parameters if each.kind in (each.VAR_POSITIONAL, each.VAR_KEYWORD)}
    wanted = [each.name for each in parameters if each.default is each.empty and each.name not in loose]
    missing = [each for each in wanted if each not in named.intersection(names)]
    if missing:
        raise HabitusError(
            f"the term {name!r} asks for {', '.join(map(repr, missing))}; free are {', '.join(map(repr, names))}: "
            "free it too, or fix it with functools.partial"
        )
    any_keyword = any(each.kind is each.VAR_KEYWORD for each in parameters)
    return tuple(each for each in names if any_keyword or each in named)
