"""Named unknowns, NumPy arrays or torch tensors, and the vector x of all their numbers that solvers
move.
"""

from collections.abc import Collection, Mapping
from dataclasses import dataclass, fields, is_dataclass
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
        if not sum(_size(value) for value in free.values()):
            raise HabitusError(
                "no number is free; expected a mapping of names to start tensors, as {'shift': "
                "zeros(3)}"
            )
        return cls(free, {name: values[name] for name in fixed})

    @property
    def names(self) -> tuple[str, ...]:
        """What terms may take, fixed values included."""
        return (*self.start, *self.fixed)

    @property
    def columns(self) -> dict[str, slice]:
        """Where each free value's numbers lie in x."""
        ends = np.cumsum([_size(value) for value in self.start.values()]).tolist()
        return {
            name: slice(end - _size(self.start[name]), end)
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


def _size(value: Any) -> int:
    return int(np.prod(np.shape(value), dtype=int))


def as_numpy(value: Any) -> np.ndarray:
    """An array in float64 of an array or a tensor."""
    return np.asarray(
        value.detach().double().cpu().numpy() if is_tensor(value) else value, dtype=float
    )
