"""Shows on the CPU that torch code would not stall a GPU: no value is read, no shape depends on one, nothing moves."""

from __future__ import annotations

from typing import Any

import torch
from torch.utils._python_dispatch import TorchDispatchMode

_READING = {
    "_local_scalar_dense": "a value is read (.item(), a tensor in `if`, float(tensor))",
    "is_nonzero": "a value is read (a tensor in `if`)",
    "equal": "a value is read (torch.equal)",
    "nonzero": "the shape of the result depends on values",
    "nonzero_numpy": "the shape of the result depends on values",
    "masked_select": "the shape of the result depends on values",
    "_unique": "the shape of the result depends on values",
    "_unique2": "the shape of the result depends on values",
    "unique_dim": "the shape of the result depends on values",
    "unique_consecutive": "the shape of the result depends on values",
    "repeat_interleave": "the shape of the result depends on values",
    "bincount": "the shape of the result depends on values",
    "linalg_solve": "the solver asks whether it succeeded; use `robots.kinematics`' elimination",
    "_linalg_check_errors": "the result of a solver is read",
    "_to_copy": "a copy between devices",
    "lift_fresh": "a tensor is made of host values (torch.tensor, torch.asarray, an index that is a list)",
}
_INDEXING = ("index", "index_put", "index_put_", "_index_put_impl_", "_unsafe_index")


class NoSync(TorchDispatchMode):
    """Context in which torch operations that would stall a GPU, or copy to or from the host, raise AssertionError.

    Conversions of dtype are let through, copies to another device are not. ``seen`` counts what ran. Conversions to
    numpy are no torch operations: while the context is open, they are refused where they begin.
    """

    def __init__(self) -> None:
        super().__init__()
        self.seen = 0
        self._kept: dict[str, Any] = {}
        self._filling = False

    def __enter__(self) -> NoSync:
        self._kept = {
            name: getattr(torch.Tensor, name)
            for name in ("__array__", "numpy", "tolist", "__setitem__")
        }
        changed = {name: _refused(name) for name in ("__array__", "numpy", "tolist")} | {
            "__setitem__": self._set_item
        }
        for name, method in changed.items():
            setattr(torch.Tensor, name, method)
        super().__enter__()
        return self

    @property
    def _set_item(self) -> Any:
        """``tensor[index] = number`` fills on a GPU; only on the CPU torch makes a tensor of the number."""

        def set_item(tensor: Any, index: Any, value: Any) -> None:
            self._filling = isinstance(value, int | float)
            try:
                self._kept["__setitem__"](tensor, index, value)
            finally:
                self._filling = False

        return set_item

    def __exit__(self, *given: Any) -> None:
        super().__exit__(*given)
        for name, method in self._kept.items():
            setattr(torch.Tensor, name, method)

    def __torch_dispatch__(
        self, func: Any, types: Any, args: Any = (), kwargs: Any = None
    ) -> Any:
        self.seen += 1
        name = func.overloadpacket.__name__
        kwargs = kwargs or {}
        harmless = _keeps_device(name, args, kwargs) or (
            name == "lift_fresh" and self._filling and args[0].ndim == 0
        )
        if name in _READING and not harmless:
            raise AssertionError(f"{name}: {_READING[name]}")
        if name in _INDEXING:
            for index in args[1]:
                if index is not None and index.dtype in (torch.bool, torch.uint8):
                    raise AssertionError(
                        f"{name}: an index of flags; the shape of the result depends on values"
                    )
        return func(*args, **kwargs)


def _keeps_device(name: str, args: Any, kwargs: dict[str, Any]) -> bool:
    return name == "_to_copy" and kwargs.get("device") in (None, args[0].device)


def _refused(name: str) -> Any:
    def refuse(*_: Any, **__: Any) -> Any:
        raise AssertionError(f"Tensor.{name}: values go to the host")

    return refuse
