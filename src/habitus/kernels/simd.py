"""Lanes: a number that is really LANES float64 numbers, or twice as many float32 numbers, one per
frame, for kernels that treat several frames at once.

Inside compiled functions a lane value is one SIMD register (`<8 x double>` or `<16 x float>` with
AVX-512, else half of it): it is added, multiplied and so on like a float, also with floats, which
spread over the lanes. Arrays of lanes are arrays (n, LANES) of float64 or (n, 2 LANES) of float32,
whose rows `load` and `store` move; their type decides that of all that is computed from them. Code
that uses only arithmetic reads like the code for one frame.

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
"""Frames that share a register, in float64; in float32 twice as many."""
CACHE_LINE = 64

_FUSE = ("contract",)


class Lane(types.Type):
    """The numba type of a lane value: `count` numbers of a type."""

    def __init__(self, number: types.Float, count: int):
        self.number = number
        self.count = count
        super().__init__(name=f"Lane{count}x{number}")

    @property
    def vector(self) -> ir.VectorType:
        """LLVM's type."""
        one = ir.DoubleType() if self.number == types.float64 else ir.FloatType()
        return ir.VectorType(one, self.count)


LANE_TYPES = {
    types.float64: Lane(types.float64, LANES),
    types.float32: Lane(types.float32, 2 * LANES),
}
"""The lane type of arrays of each type."""


@register_model(Lane)
class _LaneModel(models.PrimitiveModel):
    def __init__(self, manager, kind):
        super().__init__(manager, kind, kind.vector)


def lane_array(*shape: int, dtype: type = np.float64) -> np.ndarray:
    """Room for lanes, zeroed: (*shape, LANES) float64 or (*shape, 2 LANES) float32, on cache
    lines.
    """
    lanes = num_lanes(dtype)
    size = int(np.prod(shape)) * lanes
    memory = np.zeros(size + CACHE_LINE // np.dtype(dtype).itemsize, dtype)
    skip = (-memory.ctypes.data % CACHE_LINE) // memory.itemsize
    return memory[skip : skip + size].reshape(*shape, lanes)


def num_lanes(dtype: np.dtype | type) -> int:
    """How many numbers of a type share a register."""
    return LANES * 8 // np.dtype(dtype).itemsize


def _known(function) -> Callable[..., Any]:
    """An intrinsic, to type checkers any function: its first argument is numba's own."""
    return intrinsic(function)


def _spread(builder, kind, value):
    none = ir.Constant(kind.vector, ir.Undefined)
    one = builder.insert_element(none, value, ir.IntType(32)(0))
    zeros = ir.Constant(ir.VectorType(ir.IntType(32), kind.count), [0] * kind.count)
    return builder.shuffle_vector(one, none, zeros)


def _as_lane(context, builder, own, kind, value):
    """A value of numba's type ``own`` as a lane value of type ``kind``."""
    if own == kind:
        return value
    return _spread(builder, kind, context.cast(builder, value, own, kind.number))


def _lane_of(*kinds):
    """The one lane type among numba types; None where there is none, or several."""
    lanes = {kind for kind in kinds if isinstance(kind, Lane)}
    others = [kind for kind in kinds if not isinstance(kind, Lane | types.Float)]
    return lanes.pop() if len(lanes) == 1 and not others else None


def _teach(symbol, instruction):
    """Teach numba lane (op) lane, lane (op) number and number (op) lane."""

    @infer_global(symbol)  # pyright: ignore[reportOptionalCall]
    class _Template(AbstractTemplate):
        def generic(self, args, kws):
            kind = _lane_of(*args)
            if len(args) == 2 and kind is not None:
                return kind(*args)

    def lower(context, builder, signature, args):
        kind = signature.return_type
        pair = (
            _as_lane(context, builder, own, kind, value)
            for own, value in zip(signature.args, args, strict=True)
        )
        return getattr(builder, instruction)(*pair, flags=_FUSE)

    for pair in ((Lane, Lane), (Lane, types.Float), (types.Float, Lane)):
        lower_builtin(symbol, *pair)(lower)


_teach(operator.add, "fadd")
_teach(operator.sub, "fsub")
_teach(operator.mul, "fmul")
_teach(operator.truediv, "fdiv")


@infer_global(operator.neg)  # pyright: ignore[reportOptionalCall]
class _Negative(AbstractTemplate):
    def generic(self, args, kws):
        if len(args) == 1 and isinstance(args[0], Lane):
            return args[0](*args)


@lower_builtin(operator.neg, Lane)
def _negative(context, builder, signature, args):
    return builder.fneg(args[0])


@_known
def spread(typingctx, workspace, value):
    """The same number in every lane, of the type of an array of lanes."""
    kind = _kind(workspace)

    def codegen(context, builder, signature, args):
        return _as_lane(context, builder, signature.args[1], kind, args[1])

    return kind(workspace, value), codegen


def _call(builder, kind, name, args):
    """Call one of LLVM's own functions of a vector."""
    function = ir.FunctionType(kind.vector, [kind.vector])
    bits = 64 if kind.number == types.float64 else 32
    full_name = f"llvm.{name}.v{kind.count}f{bits}"
    return builder.call(cgutils.get_or_insert_function(builder.module, function, full_name), args)


@_known
def root(typingctx, value):
    """Square root, lane by lane."""

    def codegen(context, builder, signature, args):
        return _call(builder, value, "sqrt", args)

    return value(value), codegen


@_known
def nearest(typingctx, value):
    """The whole number nearest to each lane."""

    def codegen(context, builder, signature, args):
        return _call(builder, value, "rint", args)

    return value(value), codegen


@_known
def where_less(typingctx, left, right, then, otherwise):
    """`then` in the lanes where left < right, `otherwise` elsewhere (and where either is not a
    number).
    """
    kind = _lane_of(left, right, then, otherwise)
    if kind is None:
        raise TypingError(f"not lanes of one type: {left}, {right}, {then}, {otherwise}")

    def codegen(context, builder, signature, args):
        left, right, then, otherwise = (
            _as_lane(context, builder, own, kind, value)
            for own, value in zip(signature.args, args, strict=True)
        )
        return builder.select(builder.fcmp_ordered("<", left, right), then, otherwise)

    return kind(left, right, then, otherwise), codegen


def _pointer(context, builder, array_type, array, index, column=None):
    view = context.make_array(array_type)(context, builder, array)
    shape = cgutils.unpack_tuple(builder, view.shape)
    strides = cgutils.unpack_tuple(builder, view.strides)
    if column is None:
        column = context.get_constant(types.intp, 0)
    pointer = cgutils.get_item_pointer2(
        context,
        builder,
        view.data,
        shape,
        strides,
        "C",
        [index, column],
        wraparound=False,
        boundscheck=False,
    )
    return builder.bitcast(pointer, _kind(array_type).vector.as_pointer())


def _kind(array) -> Lane:
    """The lane type of an array (n, lanes)."""
    if not (
        isinstance(array, types.Array)
        and array.ndim == 2
        and array.layout == "C"
        and array.dtype in LANE_TYPES
    ):
        raise TypingError(
            f"lanes live in C-contiguous arrays (n, lanes) of float64 or float32, not in {array}"
        )
    return LANE_TYPES[array.dtype]


@_known
def load(typingctx, array, index):
    """Row `index` of an array (n, lanes)."""
    kind = _kind(array)

    def codegen(context, builder, signature, args):
        return builder.load(_pointer(context, builder, signature.args[0], *args), align=4)

    return kind(array, types.intp), codegen


@_known
def load_at(typingctx, array, index, column):
    """Lanes of row `index` of a wider array, from `column` on."""
    kind = _kind(array)

    def codegen(context, builder, signature, args):
        return builder.load(_pointer(context, builder, signature.args[0], *args), align=4)

    return kind(array, types.intp, types.intp), codegen


@_known
def store(typingctx, array, index, value):
    """Write row `index` of an array (n, lanes)."""
    kind = _kind(array)

    def codegen(context, builder, signature, args):
        pointer = _pointer(context, builder, signature.args[0], *args[:2])
        lanes = _as_lane(context, builder, signature.args[2], kind, args[2])
        builder.store(lanes, pointer, align=4)
        return context.get_dummy_value()

    return types.void(array, types.intp, value), codegen


@_known
def store_at(typingctx, array, index, column, value):
    """Write lanes of row `index` of a wider array, from `column` on."""
    kind = _kind(array)

    def codegen(context, builder, signature, args):
        pointer = _pointer(context, builder, signature.args[0], *args[:3])
        lanes = _as_lane(context, builder, signature.args[3], kind, args[3])
        builder.store(lanes, pointer, align=4)
        return context.get_dummy_value()

    return types.void(array, types.intp, types.intp, value), codegen
