"""Maps from network outputs to controls within their ranges."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from functools import lru_cache
from itertools import islice
from types import MappingProxyType

import torch
from torch import Tensor

from stlc.compile.backends.torch.ops import TORCH
from stlc.compile.namespace import Array, Ops
from stlc.dynamics.declaration.schema.names import ControlDecl

EPS = 1e-6
"""Offset that keeps the gradient of an angle finite where both components are 0."""

NEAR_END = 0.98
"""Share of a control's half range up to which outputs stand for given controls."""


@dataclass(frozen=True, slots=True)
class SquashKind:
    """Map from network outputs to [-1, 1], where ±1 are the ends of a control's range.

    Attributes:
        of: value from an array library and the outputs.
        c: the same as C in float32.
        outputs: number of outputs.
    """

    of: Callable[..., Array]
    c: str
    outputs: int = 1


SQUASHES: Mapping[str, SquashKind] = MappingProxyType(
    {
        "tanh": SquashKind(lambda ops, x: ops.tanh(x), "tanhf({0})"),
        "clip": SquashKind(lambda ops, x: ops.clamp(x, -1.0, 1.0), "MIN(MAX({0}, -1.0f), 1.0f)"),
        "angle": SquashKind(
            lambda ops, x, y: ops.div(ops.atan2(y, ops.add(x, EPS)), math.pi),
            f"atan2f({{1}}, {{0}} + {EPS}f) / (float)PI",
            outputs=2,
        ),
    }
)
"""`tanh` is smooth, `clip` cuts off at the ends; `angle` is the direction of a planar vector, without a
discontinuity at the ends of the range."""


def raw_width(controls: tuple[ControlDecl, ...]) -> int:
    """Number of network outputs per step: two (a planar vector) for an angle, one for any other control."""
    return sum(SQUASHES[control.squash].outputs for control in controls)


def shares(raw: Iterable[Array], controls: tuple[ControlDecl, ...], ops: Ops) -> list[Array]:
    """Controls on the scale [-1, 1], one array per control, from one array per network output."""
    columns, kinds = iter(raw), (SQUASHES[control.squash] for control in controls)
    return [kind.of(ops, *islice(columns, kind.outputs)) for kind in kinds]


def squash(raw: Tensor, controls: tuple[ControlDecl, ...]) -> Tensor:
    """Controls in physical units from network outputs: (…, raw_width) -> (…, m).

    A map of `SQUASHES` brings an output into [-1, 1], which is then scaled to the range of the control.
    """
    middle, half = _affine(controls, raw.dtype, raw.device)
    kinds = {control.squash for control in controls}
    if len(kinds) == 1 and kinds != {"angle"}:
        share = SQUASHES[kinds.pop()].of(TORCH, raw)
    else:
        share = torch.stack(shares(raw.unbind(-1), controls, TORCH), -1)
    return torch.addcmul(middle, share, half)


def unsquash(plans: Tensor, controls: tuple[ControlDecl, ...]) -> Tensor:
    """Network outputs that `squash` maps to controls in physical units: (…, m) -> (…, raw_width).

    The ends of a range, which `tanh` reaches nowhere, are approached up to `NEAR_END`.
    """
    middle, half = _affine(controls, plans.dtype, plans.device)
    found: list[Tensor] = []
    for control, unit in zip(controls, ((plans - middle) / half).unbind(-1), strict=True):
        match control.squash:
            case "tanh":
                found.append(torch.atanh(unit.clamp(-NEAR_END, NEAR_END)))
            case "clip":
                found.append(unit)
            case "angle":
                found += [torch.cos(torch.pi * unit), torch.sin(torch.pi * unit)]
    return torch.stack(found, -1)


@lru_cache(maxsize=64)
def _affine(
    controls: tuple[ControlDecl, ...], dtype: torch.dtype, device: torch.device
) -> tuple[Tensor, Tensor]:
    """Return the midpoints and the half-widths of the ranges of all controls, (m,) each."""
    low = torch.tensor([control.low for control in controls], dtype=torch.float64)
    high = torch.tensor([control.high for control in controls], dtype=torch.float64)
    return ((low + high) / 2).to(device, dtype), ((high - low) / 2).to(device, dtype)
