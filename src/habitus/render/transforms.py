"""Compiled code under torch's automatic differentiation: functions of plain numbers, operators with
derivatives, and a user's numbers in the two types that kernels are compiled for, float32 and
float64.
"""

from collections.abc import Callable
from typing import Any, TypeVar

import numpy as np
import torch
from torch import Tensor
from torch.autograd.forward_ad import unpack_dual

from habitus.errors import HabitusError

Result = TypeVar("Result")


class Operator(torch.autograd.Function):
    """A torch function whose `forward` is called straight away where nothing is derived.

    To bind its arguments and to look for transforms takes torch longer than some kernels take for
    an image.
    """

    @classmethod
    def apply(cls, *given: Any) -> Any:
        """`forward` of what is given, with derivatives where they are wanted."""
        if is_transformed() or any(
            _is_derived(value) for value in given if isinstance(value, Tensor)
        ):
            return super().apply(*given)
        with torch.no_grad():
            return cls.forward(*given)


def outside(function: Callable[..., Result], *tensors: Tensor) -> Result:
    """`function` of the plain numbers of some tensors, out of the reach of autograd and of
    torch.func's transforms.

    For what is decided by numbers and does not vary with them, such as a topology: numpy and
    compiled code work inside. HabitusError under torch.func.vmap over one of the tensors, where
    each entry would decide for itself.
    """
    plain = [tensor.detach() for tensor in tensors]
    if not is_transformed():
        with torch.no_grad():
            return function(*plain)
    results: list[Result] = []
    _Outside.apply(lambda *plain: results.append(function(*plain)), *plain)
    return results[0]


def is_transformed() -> bool:
    """Whether a transform of torch.func is at work, whose tensors are no plain numbers."""
    return torch._C._are_functorch_transforms_active()


def _is_derived(tensor: Tensor) -> bool:
    """Whether a derivative of what is made of a tensor is wanted, in reverse or (dual numbers)
    forward mode.
    """
    return (tensor.requires_grad and torch.is_grad_enabled()) or unpack_dual(
        tensor
    ).tangent is not None


class _Outside(torch.autograd.Function):
    """A function of nothing that can be derived: torch calls its forward with plain tensors, below
    all transforms.
    """

    @staticmethod
    def forward(call: Callable[..., None], *tensors: Tensor) -> Tensor:
        call(*tensors)
        return torch.zeros(())

    @staticmethod
    def setup_context(ctx, inputs, output) -> None:
        pass

    @staticmethod
    def vmap(info, in_dims, call, *tensors):
        raise HabitusError(
            "Got vertices or faces under torch.func.vmap; expected plain ones: use leading batch "
            "axes"
        )


KERNEL_TYPES = (torch.float32, torch.float64)


def real_numbers(name: str, given: Any, like: Tensor) -> Tensor:
    """Given numbers (a tensor, an array, a sequence, one number) as a tensor of float32 or float64
    on `like`'s device.

    float32 and float64 stay as they are; whole numbers, truth values and shorter floating numbers,
    in which shares of a pixel would be cut off, take the type of `like`. HabitusError: no real
    numbers.
    """
    plain = not isinstance(given, Tensor | np.ndarray | np.generic)
    try:
        converted = (
            torch.as_tensor(given, dtype=like.dtype, device=like.device)
            if plain
            else torch.as_tensor(given)
        )
    except (TypeError, ValueError, RuntimeError):
        raise HabitusError(
            f"{name} is of type {type(given).__name__}; expected real numbers"
        ) from None
    if converted.dtype.is_complex:
        raise HabitusError(
            f"{name} is {tuple(converted.shape)} {converted.dtype}; expected real numbers"
        )
    if isinstance(given, Tensor) and converted.device != like.device:
        raise HabitusError(
            f"{name} is on {converted.device}, the drawing on {like.device}; move one with .to"
        )
    return converted.to(
        like.device, converted.dtype if converted.dtype in KERNEL_TYPES else like.dtype
    )


def of_one_type(*tensors: Tensor) -> tuple[Tensor, ...]:
    """Tensors of float32 and float64 as float64 if any is: each mixture would make kernels compile
    anew.
    """
    wide = any(tensor.dtype == torch.float64 for tensor in tensors)
    return tuple(tensor.to(torch.float64) if wide else tensor for tensor in tensors)


def no_vmap() -> HabitusError:
    """What operators say to torch.func.vmap: each entry would see something else."""
    return HabitusError(
        "vmap over a drawing is not supported: give cameras, vertices or values leading batch axes"
    )
