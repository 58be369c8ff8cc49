"""A Numba type with one number for each of several rows of a batch, so that code for one row computes them all."""

import math
import operator
from typing import Any

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.core.typeconv.castgraph import Conversion
from numba.core.typing.templates import AbstractTemplate, infer_global, signature
from numba.extending import intrinsic, lower_builtin, lower_cast, models, register_model

_intrinsic: Any = intrinsic  # Any, because it changes the arguments of the functions that it decorates
_OPERATIONS = {"add": operator.add, "sub": operator.sub, "mul": operator.mul, "div": operator.truediv}
_IN_PLACE = {"add": operator.iadd, "sub": operator.isub, "mul": operator.imul}


class _Lanes(types.Type):
    """A vector with a double for each row; a float converts to a vector of equal doubles."""

    def __init__(self, count: int) -> None:
        self.count = count
        super().__init__(f"lanes({count})")

    def can_convert_from(self, typing: Any, other: Any) -> Any:
        return Conversion.safe if isinstance(other, types.Float) else None

    def unify(self, typing: Any, other: Any) -> Any:
        return self if isinstance(other, types.Float) else None


@register_model(_Lanes)
class _Model(models.PrimitiveModel):
    def __init__(self, manager: Any, kind: Any) -> None:
        super().__init__(manager, kind, ir.VectorType(ir.DoubleType(), kind.count))


class _Operation(AbstractTemplate):
    def generic(self, args: Any, keywords: Any) -> Any:
        kind = _common(*args)
        return signature(kind, *(kind for _ in args)) if isinstance(kind, _Lanes) else None


@lower_cast(types.Float, _Lanes)
def _spread(context: Any, builder: Any, given: Any, kind: Any, value: Any) -> Any:
    value, vector = context.cast(builder, value, given, types.float64), context.get_value_type(kind)
    zero = ir.Constant(ir.IntType(32), 0)
    first = builder.insert_element(ir.Constant(vector, ir.Undefined), value, zero)
    places = ir.Constant(ir.VectorType(ir.IntType(32), kind.count), [0] * kind.count)
    return builder.shuffle_vector(first, ir.Constant(vector, ir.Undefined), places)


@lower_builtin(math.sqrt, _Lanes)
def _root(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
    kind = arguments[0].type
    name = f"llvm.sqrt.v{kind.count}f64"
    return builder.call(builder.module.declare_intrinsic(name, fnty=ir.FunctionType(kind, [kind])), arguments)


def _define() -> None:
    infer_global(math.sqrt)(type("Root", (_Operation,), {}))
    for name, operation in [*_OPERATIONS.items(), *_IN_PLACE.items()]:
        infer_global(operation)(type(name, (_Operation,), {}))

        def code(context: Any, builder: Any, signature: Any, arguments: Any, name: str = name) -> Any:
            return getattr(builder, f"f{name}")(*arguments)

        lower_builtin(operation, _Lanes, _Lanes)(code)


def _common(*kinds: Any) -> Any:
    """Return the type of a result: lanes if an argument has lanes, else double."""
    return next((kind for kind in kinds if isinstance(kind, _Lanes)), types.float64)


@_intrinsic
def choose(typing: Any, a: Any, b: Any, yes: Any, no: Any) -> Any:
    """Return ``yes`` where a > b, else ``no``; where a or b is NaN, return ``no``."""

    def code(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.select(builder.fcmp_ordered(">", *arguments[:2]), *arguments[2:])

    kind = _common(a, b, yes, no)
    return kind(kind, kind, kind, kind), code


@_intrinsic(prefer_literal=True)
def stack(typing: Any, count: Any, rows: Any) -> Any:
    """Return stack memory for ``count`` vectors of ``rows`` doubles; registers may hold it if ``count`` is constant."""
    kind = _Lanes(rows.literal_value) if rows.literal_value > 1 else types.float64

    def code(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        if isinstance(count, types.IntegerLiteral):
            return cgutils.alloca_once(builder, context.get_value_type(kind), size=count.literal_value)
        return builder.alloca(context.get_value_type(kind), size=arguments[0])

    return types.CPointer(kind)(count, rows), code


@_intrinsic
def offset(typing: Any, memory: Any, count: Any) -> Any:
    """Return a pointer to entry ``count`` of an array or of other memory, without a slice's slow reference counting."""

    def code(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        start = arguments[0]
        if isinstance(memory, types.Array):
            start = context.make_array(memory)(context, builder, start).data
        return builder.gep(start, arguments[1:])

    return types.CPointer(memory.dtype)(memory, types.int64), code


@_intrinsic
def doubles(typing: Any, memory: Any) -> Any:
    """Return the memory of vectors as doubles: all lanes of the first vector, then all of the second, and so on."""

    def code(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.bitcast(arguments[0], ir.DoubleType().as_pointer())

    return types.CPointer(types.float64)(memory), code


_define()
