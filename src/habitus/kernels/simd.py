"""Lanes: a number that is really LANES float64 numbers, one per frame, for kernels that treat
several frames at once.

Inside compiled functions a lane value is one SIMD register (`<8 x double>` with AVX-512, else `<4 x
double>`): it is added, multiplied and so on like a float, also with floats, which spread over the
lanes. Arrays of lanes are float64 arrays (n, LANES) whose rows `load` and `store` move. Code that
uses only arithmetic reads like the code for one frame.

numba vectorises no such loops by itself, hence this small extension of it.
"""

import operator
from collections.abc import Callable
from typing import Any

import numpy as np
from llvmlite import binding, ir
from numba import types
from numba.core import cgutils
from numba.core.datamodel import models
from numba.core.errors import TypingError
from numba.core.typing.templates import AbstractTemplate, infer_global
from numba.extending import intrinsic, lower_builtin, register_model

LANES = 8 if binding.get_host_cpu_features().get("avx512f", False) else 4
"""Frames that share a register."""
CACHE_LINE = 64

_VECTOR = ir.VectorType(ir.DoubleType(), LANES)
_FUSE = ("contract",)


class Lane(types.Type):
    """The numba type of a lane value."""

    def __init__(self):
        super().__init__(name=f"Lane{LANES}")


lane = Lane()


@register_model(Lane)
class _LaneModel(models.PrimitiveModel):
    def __init__(self, manager, kind):
        super().__init__(manager, kind, _VECTOR)


def lane_array(*shape: int) -> np.ndarray:
    """Room for lanes, zeroed: (*shape, LANES) float64, on cache lines."""
    size = int(np.prod(shape)) * LANES
    memory = np.zeros(size + CACHE_LINE // 8)
    skip = (-memory.ctypes.data % CACHE_LINE) // 8
    return memory[skip : skip + size].reshape(*shape, LANES)


def _known(function) -> Callable[..., Any]:
    """An intrinsic, to type checkers any function: its first argument is numba's own."""
    return intrinsic(function)


def _spread(builder, value):
    one = builder.insert_element(ir.Constant(_VECTOR, ir.Undefined), value, ir.IntType(32)(0))
    zeros = ir.Constant(ir.VectorType(ir.IntType(32), LANES), [0] * LANES)
    return builder.shuffle_vector(one, ir.Constant(_VECTOR, ir.Undefined), zeros)


def _as_lane(context, builder, kind, value):
    if kind is lane:
        return value
    return _spread(builder, context.cast(builder, value, kind, types.float64))


def _teach(symbol, instruction):
    """Teach numba lane (op) lane, lane (op) number and number (op) lane."""

    @infer_global(symbol)  # pyright: ignore[reportOptionalCall]
    class _Template(AbstractTemplate):
        def generic(self, args, kws):
            if (
                len(args) == 2
                and lane in args
                and all(kind is lane or isinstance(kind, types.Float) for kind in args)
            ):
                return lane(*args)

    def lower(context, builder, signature, args):
        pair = (
            _as_lane(context, builder, kind, value)
            for kind, value in zip(signature.args, args, strict=True)
        )
        return getattr(builder, instruction)(*pair, flags=_FUSE)

    for pair in ((lane, lane), (lane, types.Float), (types.Float, lane)):
        lower_builtin(symbol, *pair)(lower)


_teach(operator.add, "fadd")
_teach(operator.sub, "fsub")
_teach(operator.mul, "fmul")
_teach(operator.truediv, "fdiv")


@infer_global(operator.neg)  # pyright: ignore[reportOptionalCall]
class _Negative(AbstractTemplate):
    def generic(self, args, kws):
        if args == (lane,):
            return lane(lane)


@lower_builtin(operator.neg, lane)
def _negative(context, builder, signature, args):
    return builder.fneg(args[0])


@_known
def spread(typingctx, value):
    """The same number in every lane."""

    def codegen(context, builder, signature, args):
        return _as_lane(context, builder, signature.args[0], args[0])

    return lane(value), codegen


def _call(builder, name, args):
    """Call one of LLVM's own functions of a vector."""
    kind = ir.FunctionType(_VECTOR, [_VECTOR])
    return builder.call(
        cgutils.get_or_insert_function(builder.module, kind, f"llvm.{name}.v{LANES}f64"), args
    )


@_known
def root(typingctx, value):
    """Square root, lane by lane."""

    def codegen(context, builder, signature, args):
        return _call(builder, "sqrt", args)

    return lane(lane), codegen


@_known
def nearest(typingctx, value):
    """The whole number nearest to each lane."""

    def codegen(context, builder, signature, args):
        return _call(builder, "rint", args)

    return lane(lane), codegen


@_known
def where_less(typingctx, left, right, then, otherwise):
    """`then` in the lanes where left < right, `otherwise` elsewhere (and where either is not a
    number).
    """

    def codegen(context, builder, signature, args):
        left, right, then, otherwise = (
            _as_lane(context, builder, kind, value)
            for kind, value in zip(signature.args, args, strict=True)
        )
        return builder.select(builder.fcmp_ordered("<", left, right), then, otherwise)

    return lane(left, right, then, otherwise), codegen


def _row_pointer(context, builder, array_type, array, index):
    view = context.make_array(array_type)(context, builder, array)
    shape = cgutils.unpack_tuple(builder, view.shape)
    strides = cgutils.unpack_tuple(builder, view.strides)
    zero = context.get_constant(types.intp, 0)
    pointer = cgutils.get_item_pointer2(
        context,
        builder,
        view.data,
        shape,
        strides,
        "C",
        [index, zero],
        wraparound=False,
        boundscheck=False,
    )
    return builder.bitcast(pointer, _VECTOR.as_pointer())


def _checked(array):
    if not (
        isinstance(array, types.Array)
        and array.ndim == 2
        and array.layout == "C"
        and array.dtype == types.float64
    ):
        raise TypingError(f"lanes live in C-contiguous float64 arrays (n, LANES), not in {array}")


@_known
def load(typingctx, array, index):
    """Row `index` of an array (n, LANES)."""
    _checked(array)

    def codegen(context, builder, signature, args):
        return builder.load(_row_pointer(context, builder, signature.args[0], *args), align=8)

    return lane(array, types.intp), codegen


@_known
def store(typingctx, array, index, value):
    """Write row `index` of an array (n, LANES)."""
    _checked(array)

    def codegen(context, builder, signature, args):
        pointer = _row_pointer(context, builder, signature.args[0], args[0], args[1])
        builder.store(_as_lane(context, builder, signature.args[2], args[2]), pointer, align=8)
        return context.get_dummy_value()

    return types.void(array, types.intp, value), codegen
