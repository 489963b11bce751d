# SPDX-License-Identifier: Apache-2.0
"""What numba takes a `held.Held` for: the address of a value that lies in memory as compiled code passes it on.

References of arrays are not counted (`compilation`): whoever made the `Held` keeps them. A change here needs another
`kernel_cache` format.
"""

from __future__ import annotations

import ctypes
from typing import Any

import numba
from numba.core import cgutils
from numba.core.imputils import lower_setattr
from numba.core.registry import cpu_target
from numba.core.types import Type
from numba.core.typing.templates import AttributeTemplate
from numba.extending import NativeValue, infer_getattr, lower_getattr, models, register_model, unbox


class HeldType(Type):
    """A `Held` whose value is of `kind`."""

    mutable = True

    def __init__(self, kind: Any) -> None:
        self.kind = kind
        super().__init__(name=f"Held({kind})")


register_model(HeldType)(models.OpaqueModel)


def of(value: Any) -> HeldType:
    """The type for a value."""
    return HeldType(numba.typeof(value))


def memory_for(held: HeldType) -> tuple[bytearray, int]:
    """Memory for a value, and its address; the memory must not grow."""
    context = cpu_target.target_context
    memory = bytearray(context.get_abi_sizeof(context.get_value_type(held.kind)))
    return memory, ctypes.addressof(ctypes.c_char.from_buffer(memory))


@infer_getattr
class _Attributes(AttributeTemplate):
    key = HeldType

    def resolve_value(self, held: HeldType) -> Any:
        return held.kind


def _place(context: Any, builder: Any, kind: HeldType, held: Any) -> Any:
    return builder.bitcast(held, context.get_value_type(kind.kind).as_pointer())


@lower_getattr(HeldType, "value")
def _read(context: Any, builder: Any, kind: HeldType, held: Any) -> Any:
    return builder.load(_place(context, builder, kind, held))


@lower_setattr(HeldType, "value")
def _write(context: Any, builder: Any, signature: Any, arguments: Any) -> None:
    held, value = arguments
    builder.store(value, _place(context, builder, signature.args[0], held))


@unbox(HeldType)
def _address_of(kind: HeldType, held: Any, c: Any) -> Any:
    number = c.pyapi.object_getattr_string(held, "address")
    pointer = c.pyapi.long_as_voidptr(number)
    c.pyapi.decref(number)
    return NativeValue(pointer, is_error=cgutils.is_not_null(c.builder, c.pyapi.err_occurred()))
