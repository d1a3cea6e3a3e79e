"""Several pixels or faces at a time, by vector instructions, where numba would go one by one; the
lesser of two.

numba's own `min` and `max` would make a first picture compile for half a second more.
"""

from collections.abc import Callable
from typing import Any

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

PIXELS = 8
"""How many pixels are drawn, and how many boxes compared at a time."""

_WHOLE = ir.IntType(32)
_REAL = ir.DoubleType()
_SINGLE = ir.FloatType()
_FLAGS, _WHOLES, _REALS, _SINGLES = (
    ir.VectorType(kind, PIXELS) for kind in (ir.IntType(1), _WHOLE, _REAL, _SINGLE)
)


def _known(function) -> Callable[..., Any]:
    """An intrinsic, to type checkers any function: its first argument is numba's own."""
    return intrinsic(function)


def _extreme(sign: str) -> Callable[..., Any]:
    """The first of two numbers if it is `sign` ("<" or ">") the second, else the second."""

    def extreme(typingctx, first, second):
        kind = typingctx.unify_types(types.unliteral(first), types.unliteral(second))

        def codegen(context, builder, signature, args):
            a, b = (
                context.cast(builder, *pair, kind)
                for pair in zip(args, signature.args, strict=True)
            )
            if isinstance(kind, types.Float):
                return builder.select(builder.fcmp_ordered(sign, a, b), a, b)
            compare = builder.icmp_signed if kind.signed else builder.icmp_unsigned
            return builder.select(compare(sign, a, b), a, b)

        return kind(first, second), codegen

    return intrinsic(extreme)


lesser = _extreme("<")
greater = _extreme(">")


@_known
def draw_span(typingctx, nearest, ids, at, x, count, start, across, f):
    """Draw face f into `count` pixels, `PIXELS` at most, from the one numbered `at` on, which is in
    column x.

    nearest: the largest w at each pixel so far; ids: whose it is; both C-contiguous (H, W). A
    face's w is start + x * across; of equally near faces the first shows.
    """

    def codegen(context, builder, signature, args):
        nearest, ids = (
            _entry(context, builder, signature.args[k], args[k], args[2]) for k in range(2)
        )
        x, count, start, across, f = args[3:]
        meant = _first(builder, count)
        columns = builder.fadd(
            _spread(builder, x, _REALS), ir.Constant(_REALS, [float(k) for k in range(PIXELS)])
        )
        slope = builder.fmul(columns, _spread(builder, across, _REALS))
        w = builder.fadd(_spread(builder, start, _REALS), slope)
        face = _spread(builder, f, _WHOLES)
        before = _load(builder, nearest, _REALS, meant)
        shown = _load(builder, ids, _WHOLES, meant)
        tie = builder.and_(
            builder.fcmp_ordered("==", w, before), builder.icmp_signed("<", face, shown)
        )
        wins = builder.and_(meant, builder.or_(builder.fcmp_ordered(">", w, before), tie))
        _store(builder, nearest, w, wins)
        _store(builder, ids, face, wins)
        return context.get_dummy_value()

    kinds = types.intp, types.float64, types.intp, types.float64, types.float64, types.int32
    return types.void(nearest, ids, *kinds), codegen


@_known
def overlapping(typingctx, bounds, first, count, low_x, high_x, low_y, high_y, least):
    """Which of `count` boxes, of `PIXELS` at most, from `first` on meet a box and reach w = least:
    bit k for the k-th.

    bounds: float32, C-contiguous (5, N), u from and to, v from and to and the largest w, with
    `PIXELS` more columns than there are boxes.
    """

    def codegen(context, builder, signature, args):
        bounds, first, count, low_x, high_x, low_y, high_y, least = args
        row = cgutils.unpack_tuple(
            builder, context.make_array(signature.args[0])(context, builder, bounds).shape
        )[1]
        meets = _first(builder, count)
        for k, (test, limit) in enumerate(
            (("<=", high_x), (">=", low_x), ("<=", high_y), (">=", low_y), (">=", least))
        ):
            at = builder.add(first, builder.mul(row, ir.Constant(row.type, k)))
            place = builder.bitcast(
                _entry(context, builder, signature.args[0], bounds, at), _SINGLES.as_pointer()
            )
            found = builder.load(place, align=4)
            meets = builder.and_(
                meets, builder.fcmp_ordered(test, found, _spread(builder, limit, _SINGLES))
            )
        return builder.zext(builder.bitcast(meets, ir.IntType(PIXELS)), ir.IntType(64))

    return types.int64(bounds, types.intp, types.intp, *[types.float32] * 5), codegen


@_known
def lowest(typingctx, bits):
    """The number of the lowest bit that is set."""

    def codegen(context, builder, signature, args):
        return builder.cttz(args[0], ir.Constant(ir.IntType(1), 1))

    return types.int64(types.int64), codegen


def _first(builder, count):
    """Flags of the first `count` lanes."""
    steps = ir.Constant(_WHOLES, list(range(PIXELS)))
    return builder.icmp_signed("<", steps, _spread(builder, builder.trunc(count, _WHOLE), _WHOLES))


def _spread(builder, value, kind):
    """A number in every lane."""
    one = builder.insert_element(ir.Constant(kind, ir.Undefined), value, _WHOLE(0))
    return builder.shuffle_vector(
        one, ir.Constant(kind, ir.Undefined), ir.Constant(_WHOLES, [0] * PIXELS)
    )


def _entry(context, builder, array_type, array, at):
    """Where entry `at` of a C-contiguous array lies."""
    return builder.gep(context.make_array(array_type)(context, builder, array).data, [at])


def _load(builder, place, kind, meant):
    """The lanes that are meant, 0 in the others."""
    signature = ir.FunctionType(kind, [kind.as_pointer(), _WHOLE, _FLAGS, kind])
    function = cgutils.get_or_insert_function(
        builder.module, signature, f"llvm.masked.load.{_name(kind)}"
    )
    return builder.call(
        function, [builder.bitcast(place, kind.as_pointer()), _WHOLE(4), meant, kind(None)]
    )


def _store(builder, place, value, meant):
    """Write the lanes that are meant."""
    kind = value.type
    signature = ir.FunctionType(ir.VoidType(), [kind, kind.as_pointer(), _WHOLE, _FLAGS])
    function = cgutils.get_or_insert_function(
        builder.module, signature, f"llvm.masked.store.{_name(kind)}"
    )
    builder.call(function, [value, builder.bitcast(place, kind.as_pointer()), _WHOLE(4), meant])


def _name(kind):
    """What LLVM calls a vector and a pointer to it."""
    name = f"v{PIXELS}{'f64' if kind == _REALS else 'i32'}"
    return f"{name}.p0{name}"
