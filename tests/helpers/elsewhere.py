"""A device that is not the processor, as a GPU is: tensors of the two do not mix, and NumPy sees neither.

Tensors on it call themselves `meta` and keep their numbers on the processor, so what is computed with them is
exact. An operation that takes tensors of both sides is refused as on a GPU, unless one is a single number.
"""

from __future__ import annotations

from typing import Any

import torch
from torch.overrides import TorchFunctionMode
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_flatten, tree_map_only

from stlc.compile.backends.torch import ops as ops_torch
from stlc.dynamics.model import controls

AWAY = torch.device("meta")
_INDEXING = {
    "aten.index.Tensor",
    "aten._index_put_impl_.default",
    "aten.index_put_.default",
    "aten.index_put.default",
}
"""Operations that take indices from the processor, on a GPU too."""


class Far(torch.Tensor):
    """A tensor on the other device."""

    near: torch.Tensor

    @staticmethod
    def __new__(cls, near: torch.Tensor) -> Far:
        made: Far = torch.Tensor._make_wrapper_subclass(  # type: ignore[attr-defined]
            cls,
            near.shape,
            strides=near.stride(),
            storage_offset=near.storage_offset(),
            dtype=near.dtype,
            device=AWAY,
            requires_grad=near.requires_grad,
        )
        made.near = near.detach()
        return made

    def __repr__(self, **_: Any) -> str:
        return f"Far({self.near!r})"

    @classmethod
    def __torch_dispatch__(cls, function, types, args=(), kwargs=None):
        return carried_out(function, args, kwargs or {})


class Elsewhere(TorchDispatchMode):
    """While it is open, tensors that are made on the device `AWAY` have numbers."""

    def __enter__(self) -> Elsewhere:
        _forget_constants()
        self._numbers = _Numbers()
        self._numbers.__enter__()
        return super().__enter__()

    def __exit__(self, *raised: Any) -> None:
        super().__exit__(*raised)
        self._numbers.__exit__(*raised)
        _forget_constants()

    def __torch_dispatch__(self, function, types, args=(), kwargs=None):
        return carried_out(function, args, kwargs or {})


def _forget_constants() -> None:
    """Those of a device are kept by its name, and tensors of the true `meta` have no numbers."""
    ops_torch._constant.cache_clear()
    controls._affine.cache_clear()


class _Numbers(TorchFunctionMode):
    """`torch.tensor`, and a list as an index, do not ask the other mode."""

    def __torch_function__(self, function, types, args=(), kwargs=None):
        kwargs = kwargs or {}
        if function is torch.tensor and kwargs.get("device") == AWAY:
            return torch.tensor(*args, **{**kwargs, "device": "cpu"}).to(AWAY)
        if function is torch.Tensor.__getitem__:
            args = tree_map_only(list, torch.tensor, args, is_leaf=lambda part: isinstance(part, list))
        return function(*args, **kwargs)


def carried_out(function: Any, args: tuple[Any, ...], kwargs: dict[str, Any]) -> Any:
    """The operation on the processor; its results lie where a real device would put them."""
    given = [leaf for leaf in tree_flatten((args, kwargs))[0] if isinstance(leaf, torch.Tensor)]
    far = [tensor for tensor in given if isinstance(tensor, Far)]
    assert all(isinstance(each, Far) or each.device != AWAY for each in given), f"{function} of no numbers"
    device = kwargs.get("device")
    if device is not None:
        away = torch.device(device).type == AWAY.type
        kwargs = {**kwargs, "device": torch.device("cpu")}
        assert not (away and kwargs.get("generator")), "a generator of the processor draws there"
    else:
        away = bool(far)
    moving = device is not None or str(function) == "aten.copy_.default"
    if far and not moving and str(function) not in _INDEXING:
        near = [tensor for tensor in given if not isinstance(tensor, Far) and tensor.dim() > 0]
        assert not near, f"{function} takes tensors of two devices"
    there = {id(tensor.near): tensor for tensor in far}
    inner = tree_map_only(Far, lambda tensor: tensor.near, (args, kwargs))
    result = function(*inner[0], **inner[1])
    if not away:
        return result

    def placed(out: torch.Tensor) -> torch.Tensor:
        return there[id(out)] if id(out) in there else Far(out)

    return tree_map_only(torch.Tensor, placed, result)
