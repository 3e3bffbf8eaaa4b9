"""Maps from network outputs to controls within their ranges."""

from __future__ import annotations

from functools import lru_cache

import torch
from torch import Tensor

from stlc.dynamics.schema.names import ControlDecl

EPS = 1e-6
"""Offset that keeps the gradient of an angle finite where both components are 0."""

NEAR_END = 0.98
"""Share of a control's half range up to which outputs stand for given controls."""


def raw_width(controls: tuple[ControlDecl, ...]) -> int:
    """Number of network outputs per step: two (a planar vector) for an angle, one for any other control."""
    return sum(2 if control.squash == "angle" else 1 for control in controls)


def squash(raw: Tensor, controls: tuple[ControlDecl, ...]) -> Tensor:
    """Controls in physical units from network outputs: (…, raw_width) -> (…, m).

    `tanh` (smooth) or `clip` (cut off at the ends) brings an output into [-1, 1], which is then scaled to the
    range of the control. `angle` gives the direction of a planar vector, two outputs, without discontinuity
    at the ends of the range.
    """
    middle, half = _affine(controls, raw.dtype, raw.device)
    kinds = {control.squash for control in controls}
    if kinds == {"tanh"}:
        return torch.addcmul(middle, torch.tanh(raw), half)
    if kinds == {"clip"}:
        return torch.addcmul(middle, torch.clamp(raw, -1.0, 1.0), half)
    return torch.addcmul(middle, torch.stack(_units(raw, controls), -1), half)


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


def _units(raw: Tensor, controls: tuple[ControlDecl, ...]) -> list[Tensor]:
    """Map network outputs to controls on the scale [-1, 1], where ±1 are the ends of a control's range.

    Returns one tensor per control.
    """
    columns = iter(raw.unbind(-1))
    out: list[Tensor] = []
    for control in controls:
        first = next(columns)
        match control.squash:
            case "tanh":
                out.append(torch.tanh(first))
            case "clip":
                out.append(torch.clamp(first, -1.0, 1.0))
            case "angle":
                out.append(torch.atan2(next(columns), first + EPS) / torch.pi)
    return out


@lru_cache(maxsize=64)
def _affine(
    controls: tuple[ControlDecl, ...], dtype: torch.dtype, device: torch.device
) -> tuple[Tensor, Tensor]:
    """Return the midpoints and the half-widths of the ranges of all controls, (m,) each."""
    low = torch.tensor([control.low for control in controls], dtype=torch.float64)
    high = torch.tensor([control.high for control in controls], dtype=torch.float64)
    return ((low + high) / 2).to(device, dtype), ((high - low) / 2).to(device, dtype)
