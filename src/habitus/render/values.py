"""Numbers that arrive from a user, in the two types that kernels are compiled for: float32 and
float64.
"""

from typing import Any

import numpy as np
import torch
from torch import Tensor

from habitus.errors import HabitusError

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
        found = (
            torch.as_tensor(given, dtype=like.dtype, device=like.device)
            if plain
            else torch.as_tensor(given)
        )
    except (TypeError, ValueError, RuntimeError):
        raise HabitusError(
            f"{name} is of type {type(given).__name__}; expected real numbers"
        ) from None
    if found.dtype.is_complex:
        raise HabitusError(f"{name} is {tuple(found.shape)} {found.dtype}; expected real numbers")
    if isinstance(given, Tensor) and found.device != like.device:
        raise HabitusError(
            f"{name} is on {found.device}, the drawing on {like.device}; move one with .to"
        )
    return found.to(like.device, found.dtype if found.dtype in KERNEL_TYPES else like.dtype)


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
