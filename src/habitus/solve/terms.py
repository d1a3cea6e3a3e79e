"""One vocabulary of terms: a named residual of named unknowns with a weight and, if wanted, a
robust loss.

    cost of a term = 1/2 w |r|^2,        robust: 1/2 w sum over blocks i of rho_i(|r_i|^2).

A recipe writes its energy as a dictionary of terms; `habitus.solve.minimize.minimize` takes the
dictionary. The unknowns are NumPy arrays or torch tensors by name; `Unknowns` lays all their
numbers out in the vector x that solvers move.
"""

import inspect
import math
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, fields, is_dataclass
from functools import cached_property
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from habitus.arrays import is_tensor
from habitus.errors import HabitusError

Values = Mapping[str, Any]
"""Arrays or tensors by name."""


def torch_module(why: str) -> Any:
    """torch, or a HabitusError that says what to do without it."""
    try:
        import torch
    except ImportError as error:
        raise HabitusError(
            f"{why}, which takes PyTorch: return Jacobians too, or install habitus[torch]"
        ) from error
    return torch


def kind_of(value: Any) -> str:
    """What a value is, for messages."""
    if is_tensor(value):
        return f"a tensor of {value.dtype}"
    return (
        f"an array of {value.dtype}"
        if isinstance(value, np.ndarray)
        else f"a {type(value).__name__}"
    )


@dataclass(frozen=True, eq=False)
class Unknowns:
    """Named values of any shape, dtype and device: those that are free make up the vector x (N,),
    in float64.
    """

    start: dict[str, Any]
    fixed: dict[str, Any]

    @classmethod
    def of(cls, given: Any, fixed: Collection[str] = ()) -> "Unknowns":
        """From a mapping or a dataclass of arrays; HabitusError where there is nothing to move, or
        no array.
        """
        values = {name: _copied(name, value) for name, value in _named(given).items()}
        for name in fixed:
            if name not in values:
                raise HabitusError(
                    f"{name!r} cannot be fixed; the values are {', '.join(map(repr, values))}"
                )
        free = {name: value for name, value in values.items() if name not in fixed}
        if not sum(_num_values(value) for value in free.values()):
            raise HabitusError(
                "no number is free; expected a mapping of names to start tensors, as {'shift': "
                "zeros(3)}"
            )
        return cls(free, {name: values[name] for name in fixed})

    @property
    def names(self) -> tuple[str, ...]:
        """What terms may take, fixed values included."""
        return (*self.start, *self.fixed)

    @cached_property
    def columns(self) -> dict[str, slice]:
        """Where each free value's numbers lie in x."""
        ends = np.cumsum([_num_values(value) for value in self.start.values()]).tolist()
        return {
            name: slice(end - _num_values(self.start[name]), end)
            for name, end in zip(self.start, ends, strict=True)
        }

    @property
    def vector(self) -> Float[np.ndarray, " N"]:
        """The start as x."""
        return np.concatenate([np.ravel(as_numpy(value)) for value in self.start.values()])

    def held(self, masks: Mapping[str, Any]) -> Bool[np.ndarray, " N"] | None:
        """Which numbers of x masks hold: mask (of the value's shape, or broadcast to it) False;
        None where all are free.
        """
        held = np.zeros(len(self.vector), dtype=bool)
        for name, mask in masks.items():
            if name in self.fixed:
                continue
            if name not in self.start:
                raise HabitusError(
                    f"a mask is named {name!r}; the values are {', '.join(map(repr, self.names))}"
                )
            shape = np.shape(self.start[name])
            try:
                whole = np.broadcast_to(np.asarray(mask, dtype=bool), shape)
            except ValueError as error:
                raise HabitusError(
                    f"the mask of {name!r} has shape {np.shape(mask)}; expected {shape}"
                ) from error
            held[self.columns[name]] = ~whole.ravel()
        return held if held.any() else None

    def limited(
        self, step: Float[np.ndarray, " N"], max_step: Mapping[str, float]
    ) -> Float[np.ndarray, " N"]:
        """A step cut short, in its own direction, so that no number of an unknown changes by more
        than max_step.
        """
        share = 1.0
        for name, longest in max_step.items():
            if name in self.start:
                size = float(np.abs(step[self.columns[name]]).max(initial=0.0))
                share = min(share, longest / size) if size > longest else share
        return step if share == 1.0 else share * step

    @property
    def in_torch(self) -> bool:
        """Whether any value is a tensor; then all terms are given tensors."""
        return any(is_tensor(value) for value in (*self.start.values(), *self.fixed.values()))

    def values(self, x: Float[np.ndarray, " N"]) -> dict[str, Any]:
        """float64 arrays, or tensors where the start has any, in the start's shapes."""
        return (
            self.tensors(x)
            if self.in_torch
            else {**self._arrays(x), **{k: as_numpy(v) for k, v in self.fixed.items()}}
        )

    def tensors(self, x: Float[np.ndarray, " N"]) -> dict[str, Any]:
        """float64 tensors in the start's shapes, on its devices."""
        torch = torch_module("a term gives no Jacobians and is differentiated by autodiff")
        parts = {**self._arrays(x), **{name: as_numpy(value) for name, value in self.fixed.items()}}
        like = {**self.start, **self.fixed}
        return {
            name: torch.tensor(
                part,
                dtype=torch.float64,
                device=like[name].device if is_tensor(like[name]) else None,
            )
            for name, part in parts.items()
        }

    def _arrays(self, x: Float[np.ndarray, " N"]) -> dict[str, Any]:
        return {
            name: np.reshape(x[at], np.shape(self.start[name])).copy()
            for name, at in self.columns.items()
        }

    def like_start(self, x: Float[np.ndarray, " N"]) -> dict[str, Any]:
        """All values in kind: arrays or tensors of the start's dtypes, fixed ones as they were
        given.
        """
        values: dict[str, Any] = {}
        for name, part in self._arrays(x).items():
            like = self.start[name]
            values[name] = like.new_tensor(part) if is_tensor(like) else part.astype(like.dtype)
        return {name: values.get(name, self.fixed.get(name)) for name in self.names}


def _named(given: Any) -> dict[str, Any]:
    if isinstance(given, Mapping):
        return dict(given)
    if is_dataclass(given) and not isinstance(given, type):
        values = {field.name: getattr(given, field.name) for field in fields(given)}
        return {name: value for name, value in values.items() if value is not None}
    raise HabitusError(
        f"free is a {type(given).__name__}; expected a mapping of names to start tensors, or a "
        "dataclass of them"
    )


def _copied(name: str, value: Any) -> Any:
    if is_tensor(value) and value.dtype.is_floating_point:
        return value.detach().clone()
    if isinstance(value, np.ndarray) and np.issubdtype(value.dtype, np.floating):
        return value.copy()
    raise HabitusError(
        f"the free {name!r} is {kind_of(value)}; expected a floating tensor or array: "
        "tensor.double()"
    )


def _num_values(value: Any) -> int:
    return math.prod(np.shape(value))


def as_numpy(value: Any) -> np.ndarray:
    """An array in float64 of an array or a tensor."""
    return np.asarray(
        value.detach().double().cpu().numpy() if is_tensor(value) else value, dtype=float
    )


Jacobians = Mapping[str, Any]
"""Of each unknown a term takes: array, tensor or scipy.sparse, (numbers of the residual, numbers of
the unknown).
"""


@dataclass(frozen=True, eq=False)
class GemanMcClure:
    """Geman-McClure's robust loss rho(d^2) = s^2 d^2 / (s^2 + d^2) of residual blocks (T 3.6).

    A block is the last axis of the residual. scale: s in the residual's unit, broadcast over the
    other axes; infinite for plain squares. Solvers re-weight iteratively: gradient and matrix take
    rho' = (s^2 / (s^2 + d^2))^2.
    """

    scale: Any

    def loss(self, residual: Any) -> Any:
        """rho of each block: residual (*blocks, d) -> (*blocks,), NumPy or torch."""
        squared = (residual * residual).sum(-1)
        return squared / (1.0 + squared * self._inverse_squared(residual))

    def weights(self, residual: Any) -> Any:
        """rho' of each block: residual (*blocks, d) -> (*blocks,), NumPy or torch."""
        squared = (residual * residual).sum(-1)
        return 1.0 / (1.0 + squared * self._inverse_squared(residual)) ** 2

    def _inverse_squared(self, residual: Any) -> Any:
        inverse = 1.0 / np.square(np.asarray(self.scale, dtype=float))
        return residual.new_tensor(inverse) if is_tensor(residual) else inverse


def geman_mcclure_weight(distance: np.ndarray, scale: np.ndarray | float) -> np.ndarray:
    """Weight in 0..1 of a residual of length ``distance``: (s² / (s² + d²))², the loss being s² d²
    / (s² + d²).
    """
    return (1.0 / (1.0 + np.square(distance / scale))) ** 2


@dataclass(frozen=True, eq=False)
class Quadratic:
    """A cost with its own normal equations, for terms of so many residuals that a Jacobian would
    not fit.

    cost: 1/2 |r|^2, robust weights included (they are held within a linearisation). derivatives:
    called only where they are needed; gives the gradient of each unknown that the term takes, in
    the unknown's shape or flat, and blocks of the Gauss-Newton matrix by pairs of names, missing
    pairs being zero. A block is (numbers of the first, numbers of the second), dense or
    scipy.sparse, one of each pair; or, for unknowns (T, ...) whose T entries do not meet,

        (T, n, m) between two such unknowns: entry t of one with entry t of the other,
        (T, n, B) between such an unknown, named first, and one of B numbers that all share.
    """

    cost: float
    derivatives: Callable[[], tuple[Mapping[str, Any], Mapping[tuple[str, str], Any]]]


@dataclass(frozen=True, eq=False)
class Term:
    """A residual of named unknowns, its weight (of the square: cost 1/2 w |r|^2) and, optionally, a
    robust loss.

        Term(lambda trans: 0.02 - trans[:, 1], weight=100.0)

    residual: its parameters' names say which unknowns it takes, as float64 arrays or tensors. It
    returns residuals of any shape, always as many; or (residual, Jacobians), a mapping from each
    unknown it takes to a dense or scipy.sparse matrix (residuals, numbers of the unknown), or a
    function without parameters that returns the mapping and is called only where derivatives are
    needed; or a `Quadratic`, its cost with normal equations. Otherwise it is differentiated by
    torch's autodiff. name: how it is reported
    where no dictionary names it. takes: the unknowns' names where the residual takes any keyword
    and not all of them.
    """

    residual: Callable[..., Any]
    weight: float = 1.0
    robust: GemanMcClure | None = None
    name: str = "objective"
    takes: tuple[str, ...] | None = None

    def __call__(self, values: Values) -> "Outcome":
        """What the term gives at these values; HabitusError as `minimize` says."""
        return self.bound(tuple(values))(values)

    def bound(
        self, names: tuple[str, ...], name: str | None = None, weight: float | None = None
    ) -> "BoundTerm":
        """The term among unknowns of these names."""
        takes = (
            _takes(name or self.name, self.residual, names) if self.takes is None else self.takes
        )
        return BoundTerm(name or self.name, self, self.weight if weight is None else weight, takes)


@dataclass(frozen=True, eq=False)
class Outcome:
    """What a term gave: residual in float64, of its own shape, or a cost without axes; perhaps
    Jacobians, or normal equations.
    """

    residual: Any
    robust: GemanMcClure | None = None
    jacobians: Jacobians | Callable[[], Jacobians] | None = None
    quadratic: Quadratic | None = None

    @property
    def value(self) -> Any:
        """The residual (R,), or the cost."""
        return self.residual.reshape(-1) if self.residual.ndim else self.residual

    @property
    def is_cost(self) -> bool:
        """Whether this is a cost without normal equations, which only L-BFGS takes."""
        return self.residual.ndim == 0 and self.quadratic is None

    @property
    def explicit(self) -> bool:
        """Whether derivatives come with it."""
        return self.jacobians is not None or self.quadratic is not None

    @property
    def cost(self) -> Any:
        """1/2 |r|^2 or 1/2 sum rho, unweighted; a number without axes is a cost itself."""
        if self.residual.ndim == 0:
            return self.residual
        if self.robust is not None:
            return 0.5 * self.robust.loss(self.residual).sum()
        return 0.5 * (self.value @ self.value)

    @property
    def root_weights(self) -> Any:
        """sqrt(rho') of each residual (R,), None without a robust loss."""
        if self.robust is None or self.is_cost:
            return None
        weights = self.robust.weights(self.residual)[..., None] ** 0.5
        return (weights + 0.0 * self.residual).reshape(-1)


@dataclass(frozen=True, eq=False)
class BoundTerm:
    """A term and the unknowns it takes.

    What the start has shown: the number of its residuals, whether it gives Jacobians, whether it is
    a cost already.
    """

    name: str
    term: Term
    weight: float
    takes: tuple[str, ...]
    count: int | None = None
    explicit: bool = False
    is_cost: bool = False

    def __call__(self, values: Values) -> Outcome:
        """The term at these values; HabitusError for anything but floating residuals, always as
        many numbers.
        """
        value: Any = self.term.residual(**{name: values[name] for name in self.takes})
        jacobians = None
        if isinstance(value, Quadratic):
            return Outcome(np.array(value.cost, dtype=float), quadratic=self._unscaled(value))
        if isinstance(value, tuple) and len(value) == 2:
            value, jacobians = value
        value = self._checked(value)
        if self.count not in (None, _size(value)):
            raise HabitusError(
                f"the term {self.name!r} gave {self.count} residuals at the start and "
                f"{_size(value)} later; "
                "keep their number, for example by multiplying with a mask"
            )
        if not _size(value):
            raise HabitusError(f"the term {self.name!r} gives no residuals; expected at least one")
        return Outcome(value, self.term.robust, jacobians)

    def _unscaled(self, value: Quadratic) -> Quadratic:
        """As it is; HabitusError where the term has a robust loss as well."""
        if self.term.robust is not None:
            raise HabitusError(
                f"the term {self.name!r} gives normal equations and has a robust loss; weigh the "
                "residuals within the term"
            )
        return value

    def _checked(self, value: Any) -> Any:
        """As float64."""
        if is_tensor(value) and value.dtype.is_floating_point:
            return value.double()
        if isinstance(value, np.ndarray | np.floating) and np.issubdtype(value.dtype, np.floating):
            return np.asarray(value, dtype=float)
        raise HabitusError(
            f"the term {self.name!r} gives {kind_of(value)}; expected a floating tensor of "
            "residuals, or an array"
        )


def _size(value: Any) -> int:
    return int(value.numel()) if is_tensor(value) else int(value.size)


def read_terms(
    objective: Any, weights: Mapping[str, float], names: tuple[str, ...]
) -> list[BoundTerm]:
    """Terms of a mapping of terms or functions, or of one alone; `weights` take the place of the
    terms' own.
    """
    if isinstance(objective, Mapping):
        given = dict(objective)
    else:
        given = {objective.name if isinstance(objective, Term) else "objective": objective}
    if not given:
        raise HabitusError(
            "the objective has no terms; expected a function or a mapping of names to functions"
        )
    for name in weights:
        if name not in given:
            raise HabitusError(
                f"a weight is named {name!r}; the terms are {', '.join(map(repr, given))}"
            )
    bound = []
    for name, each in given.items():
        term = each if isinstance(each, Term) else Term(each, name=name)
        weight = weights.get(name, term.weight)
        if not 0.0 <= float(weight) < np.inf:
            raise HabitusError(
                f"the weight of {name!r} is {weight}; expected a finite number of 0 or more"
            )
        bound.append(term.bound(names, name, float(weight)))
    return bound


def _takes(name: str, function: Any, names: tuple[str, ...]) -> tuple[str, ...]:
    """The unknowns among a function's parameters; all of them where it takes any keyword or does
    not tell.
    """
    if not callable(function):
        raise HabitusError(
            f"the term {name!r} is a {type(function).__name__}; expected a function of the free "
            "values"
        )
    try:
        parameters = inspect.signature(function).parameters.values()
    except (TypeError, ValueError):
        return names
    named = {
        each.name
        for each in parameters
        if each.kind in (each.POSITIONAL_OR_KEYWORD, each.KEYWORD_ONLY)
    }
    loose = {
        each.name for each in parameters if each.kind in (each.VAR_POSITIONAL, each.VAR_KEYWORD)
    }
    required = [
        each.name for each in parameters if each.default is each.empty and each.name not in loose
    ]
    missing = [each for each in required if each not in named.intersection(names)]
    if missing:
        raise HabitusError(
            f"the term {name!r} asks for {', '.join(map(repr, missing))}; free are "
            f"{', '.join(map(repr, names))}: "
            "free it too, or fix it with functools.partial"
        )
    any_keyword = any(each.kind is each.VAR_KEYWORD for each in parameters)
    return tuple(each for each in names if any_keyword or each in named)
