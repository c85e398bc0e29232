"""Arithmetic of kernels on eight numbers at once: a type of numba, `LANES` lanes of float32 or int32.

The compiler turns loops over many numbers into vectors by itself. Runs of pixels are short, and read and write the same
array: there it would first compare the places, and do what is left over number by number.
"""

from __future__ import annotations

import operator
from collections.abc import Callable
from typing import Any

import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.core.typing.templates import AbstractTemplate, infer_global, signature
from numba.extending import intrinsic, lower_builtin, models, register_model

LANES = 8
"""Numbers of a vector."""
VECTORS = {
    types.float32: ir.VectorType(ir.FloatType(), LANES),
    types.int32: ir.VectorType(ir.IntType(32), LANES),
}
"""Type of LLVM by that of a number."""


def kernel_step(function: Callable[..., Any]) -> Callable[..., Any]:
    """`numba.extending.intrinsic`, for checkers of types: callers leave out the first parameter."""
    return intrinsic(function)


class Lanes(types.Type):
    """`LANES` numbers of the type ``of``."""

    def __init__(self, of: types.Type) -> None:
        self.of = of
        super().__init__(f"Lanes({of})")


FLOATS = Lanes(types.float32)
INTS = Lanes(types.int32)


@register_model(Lanes)
class _LanesModel(models.PrimitiveModel):
    """Lanes are kept in a vector register."""

    def __init__(self, manager: Any, kind: Any) -> None:
        super().__init__(manager, kind, VECTORS[kind.of])


def splat(builder: ir.IRBuilder, value: Any, of: types.Type) -> Any:
    """A vector with ``value``, of type ``of``, in every lane."""
    kind = VECTORS[of]
    none = ir.Constant(kind, ir.Undefined)
    first = builder.insert_element(none, value, ir.Constant(ir.IntType(32), 0))
    every = ir.Constant(VECTORS[types.int32], [0] * LANES)
    return builder.shuffle_vector(first, none, every)


def counted(builder: ir.IRBuilder, first: Any) -> Any:
    """The vector ``first``, ``first + 1``, ... of i32."""
    steps = ir.Constant(VECTORS[types.int32], list(range(LANES)))
    return builder.add(splat(builder, first, types.int32), steps)


def _define(act: Callable[[Any, Any], Any], for_floats: str, for_ints: str) -> None:
    """Define an operator for lanes with lanes, and for lanes with a number on either side, by names of `IRBuilder`."""

    def generic(self, arguments, keywords):
        kinds = [kind for kind in arguments if isinstance(kind, Lanes)]
        if not kinds:
            return None
        number = kinds[0].of
        return signature(
            kinds[0], *(kind if kind in kinds else number for kind in arguments)
        )

    infer: Any = infer_global(act)
    infer(type(f"_{act.__name__}", (AbstractTemplate,), {"generic": generic}))

    def lower(context, builder, signature, arguments):
        of = signature.return_type.of
        whole = [
            value if isinstance(kind, Lanes) else splat(builder, value, of)
            for kind, value in zip(signature.args, arguments, strict=True)
        ]
        if of == types.float32:
            return getattr(builder, for_floats)(*whole, flags=("fast",))
        return getattr(builder, for_ints)(*whole)

    for kinds in ((Lanes, Lanes), (Lanes, types.Number), (types.Number, Lanes)):
        lower_builtin(act, *kinds)(lower)


_define(operator.add, "fadd", "add")
_define(operator.sub, "fsub", "sub")
_define(operator.mul, "fmul", "mul")
_define(operator.and_, "and_", "and_")


def _place(context: Any, builder: Any, kind: Any, array: Any, *at: Any) -> Any:
    """Pointer to the lanes that begin at ``array[at]``, for an index per axis."""
    view = context.make_array(kind)(context, builder, array)
    place = cgutils.get_item_pointer(
        context, builder, kind, view, list(at), wraparound=False
    )
    return builder.bitcast(place, VECTORS[kind.dtype].as_pointer())


@kernel_step
def lanes_at(typingctx, array, place):
    """The lanes from ``array[place]`` on, of a flat array of f32 or i32; ``place`` u64."""

    def generate(context, builder, signature, arguments):
        at = _place(context, builder, signature.args[0], *arguments)
        return builder.load(at, align=4)

    return Lanes(array.dtype)(array, place), generate


@kernel_step
def put_lanes(typingctx, array, place, lanes):
    """Write lanes from ``array[place]`` on, of a flat array of f32 or i32; ``place`` u64."""

    def generate(context, builder, signature, arguments):
        array, place, lanes = arguments
        at = _place(context, builder, signature.args[0], array, place)
        builder.store(lanes, at, align=4)
        return context.get_dummy_value()

    return types.void(array, place, lanes), generate


@kernel_step
def lanes_from(typingctx, first):
    """The numbers ``first``, ``first + 1``, ... as lanes of f32; ``first`` i32."""

    def generate(context, builder, signature, arguments):
        return builder.sitofp(counted(builder, arguments[0]), VECTORS[types.float32])

    return FLOATS(types.int32), generate


@kernel_step
def floor_of(typingctx, value):
    """The largest integer that is not above ``value``, lanes of f32 or one f32, in the same type."""

    def generate(context, builder, signature, arguments):
        kind = arguments[0].type
        name = "llvm.floor.f32"
        if isinstance(signature.return_type, Lanes):
            name = f"llvm.floor.v{LANES}f32"
        floor = cgutils.get_or_insert_function(
            builder.module, ir.FunctionType(kind, [kind]), name
        )
        return builder.call(floor, arguments)

    return value(value), generate


@kernel_step
def whole_of(typingctx, value):
    """``value``, lanes of f32 or one f32, as i32; digits behind the point are dropped."""
    found = INTS if isinstance(value, Lanes) else types.int32

    def generate(context, builder, signature, arguments):
        kind = context.get_value_type(signature.return_type)
        return builder.fptosi(arguments[0], kind)

    return found(value), generate


def z_buffer(shape: tuple[int, ...], kind: type[np.generic]) -> np.ndarray:
    """Zeros of a shape, with room behind the last pixel for the `LANES` that `draw_lanes` reads and writes."""
    size = int(np.prod(shape))
    return np.zeros(size + LANES, kind)[:size].reshape(shape)


@kernel_step
def draw_lanes(typingctx, inverse, ids, row, column, tag, start, step, done, count):
    """Draw `LANES` pixels of a row from ``column``: where nearer, inverse depth and ``tag`` replace what is there.

    Args:
        inverse, ids: the z-buffer, (h, w) f32 and i32.
        row, column: first pixel, u64.
        tag: i32.
        start, step: inverse depth of the span's first pixel and its change per pixel, f32.
        done: pixels of the span before ``column``, i32.
        count: pixels of the span, i32; lanes from ``count - done`` on change nothing.
    """
    signature = types.void(inverse, ids, row, column, tag, start, step, done, count)

    def generate(context, builder, signature, arguments):
        inverse, ids, row, column, tag, start, step, done, count = arguments
        at = [row, column]
        depths = _place(context, builder, signature.args[0], inverse, *at)
        tags = _place(context, builder, signature.args[1], ids, *at)
        number = counted(builder, done)
        way = builder.fmul(
            splat(builder, step, types.float32),
            builder.sitofp(number, VECTORS[types.float32]),
        )
        # No fast arithmetic: depths are equal to the bit with those of a loop pixel by pixel.
        found = builder.fadd(splat(builder, start, types.float32), way)
        before = builder.load(depths, align=4)
        old = builder.load(tags, align=4)
        nearer = builder.and_(
            builder.fcmp_ordered(">", found, before),
            builder.icmp_signed("<", number, splat(builder, count, types.int32)),
        )
        builder.store(builder.select(nearer, found, before), depths, align=4)
        builder.store(
            builder.select(nearer, splat(builder, tag, types.int32), old), tags, align=4
        )
        return context.get_dummy_value()

    return signature, generate
