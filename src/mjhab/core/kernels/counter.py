"""A counter that several threads share, for kernels that divide work among threads."""

from __future__ import annotations

from numba import types
from numba.extending import intrinsic


@intrinsic
def take_next(typing_context, counter):
    """Return ``counter[0]`` of a contiguous (1,) int64 array and add 1, as one atomic operation."""
    signature = types.int64(counter)

    def generate(context, builder, signature, arguments):
        array = context.make_array(signature.args[0])(context, builder, arguments[0])
        one = context.get_constant(types.int64, 1)
        # Monotonic is enough: threads share nothing but the number.
        return builder.atomic_rmw("add", array.data, one, "monotonic")

    return signature, generate
