"""Layout: which entry of a struct's int64 table holds which size, or the address of which array.

A kernel takes all the memory of a struct as one table (see `lanes`). `TREE = Layout("nv nq", "parent home")` names the
entries once; in kernels `m[TREE.nv]` is a size and `floats(m, TREE.home)` an array. Numba compiles an attribute of a
layout as the integer that it is.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numba import extending, types
from numba.core.typing.templates import AttributeTemplate

infer_getattr: Any = extending.infer_getattr
lower_getattr_generic: Any = extending.lower_getattr_generic


class Layout:
    """The entries of a table, by names separated by spaces: sizes first, then the addresses of arrays."""

    def __init__(self, sizes: str, arrays: str) -> None:
        self.sizes, self.arrays = sizes.split(), arrays.split()
        self._entries = {name: entry for entry, name in enumerate(self.sizes + self.arrays)}

    def __getattr__(self, name: str) -> int:
        try:
            return self.__dict__["_entries"][name]
        except KeyError:
            raise AttributeError(f"the layout has no entry {name!r}.") from None

    def table(self, sizes: Mapping[str, int], arrays: Mapping[str, np.ndarray]) -> np.ndarray:
        """The table of these sizes and arrays, which the caller keeps alive."""
        addresses = (arrays[name].ctypes.data for name in self.arrays)
        return np.array([*(sizes[name] for name in self.sizes), *addresses], dtype=np.int64)


class _LayoutType(types.Dummy):
    def __init__(self, layout: Layout) -> None:
        self.layout = layout
        super().__init__(name=f"Layout({' '.join(layout.sizes + layout.arrays)})")


extending.register_model(_LayoutType)(extending.models.OpaqueModel)


@extending.typeof_impl.register(Layout)
def _typeof(layout: Layout, context: Any) -> _LayoutType:
    return _LayoutType(layout)


@infer_getattr
class _Entry(AttributeTemplate):
    key = _LayoutType

    def generic_resolve(self, value: _LayoutType, attr: str) -> Any:
        return types.int64 if attr in value.layout.sizes or attr in value.layout.arrays else None


@lower_getattr_generic(_LayoutType)
def _get_entry(context: Any, builder: Any, layout_type: _LayoutType, value: Any, attr: str) -> Any:
    return context.get_constant(types.int64, getattr(layout_type.layout, attr))
