"""Calls of a compiled law from numba functions, by address: no allocation, no Python, no lock.

`call_value(address, x, p, out)`, `call_linearise(address, x, p, out, J)`, `call_push(address, x, p,
d, out)` and `call_pull(address, x, p, w, p_bar)` can be used in any function that numba compiles,
also in one that is cached on disk: an address is an ordinary integer argument. The arrays are
C-contiguous float64 arrays of any number of dimensions, as long as the law reads and writes; their
sizes are not checked, and an array that is written must not overlap another. An argument of another
type is a numba TypingError.
"""

from typing import Any

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.core.errors import TypingError
from numba.extending import intrinsic


def _call(address: Any, *arrays: Any) -> tuple[Any, Any]:
    """The signature and the code of a call of void(*)(double*, ...) at `address`."""
    if not isinstance(address, types.Integer):
        raise TypingError(f"the address of a law must be an integer, not {address}")
    for array in arrays:
        if not (
            isinstance(array, types.Array) and array.dtype == types.float64 and array.layout == "C"
        ):
            raise TypingError(f"a compiled law takes C-contiguous float64 arrays, not {array}")

    def code(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        pointer = ir.DoubleType().as_pointer()
        kind = ir.FunctionType(ir.VoidType(), [pointer] * len(arrays)).as_pointer()
        number = context.cast(builder, values[0], signature.args[0], types.intp)
        data = [context.make_array(t)(context, builder, v).data for t, v in zip(arrays, values[1:])]
        builder.call(builder.inttoptr(number, kind), data)
        return cgutils.get_null_value(context.get_value_type(types.none))

    return types.void(address, *arrays), code


def _value(typingctx, address, x, p, out):
    """Value of the law at `address`: out[o]."""
    return _call(address, x, p, out)


def _linearise(typingctx, address, x, p, out, J):
    """Value out[o] and Jacobian J[o, i] of the law at `address`."""
    return _call(address, x, p, out, J)


def _pull(typingctx, address, x, p, w, p_bar):
    """Adds Σ w[o]·∂out[o]/∂p[j] to p_bar[j]."""
    return _call(address, x, p, w, p_bar)


def _push(typingctx, address, x, p, d, out):
    """Derivative out[o] of the law at `address` along the direction d of its parameters."""
    return _call(address, x, p, d, out)


call_value: Any = intrinsic(_value)
call_linearise: Any = intrinsic(_linearise)
call_pull: Any = intrinsic(_pull)
call_push: Any = intrinsic(_push)
