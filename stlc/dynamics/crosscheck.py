"""Comparison of the compiled forward kinematics with the package pytorch-kinematics.

`stlc.dynamics.declaration.kinematics` unrolls a chain of joints into a few operations; pytorch-kinematics
multiplies batches of transforms. If that package is installed, `stlc system check` compares the two.
"""

from __future__ import annotations

import io
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import dataclass
from importlib.util import find_spec
from typing import ClassVar
from warnings import catch_warnings

import numpy as np
import torch

from stlc.compile.backends.array.arith import ArrayProgram
from stlc.compile.ir import nodes as ir
from stlc.diagnostics import SystemFileError
from stlc.dynamics.declaration.functions import FunctionDecl
from stlc.dynamics.declaration.kinematics import Doubles, read_urdf

LIBRARY = "pytorch-kinematics"
POSITIONS = 256
_NEAR = 1e-5
"""Tolerance of the comparison, relative to the reach: the library keeps offsets in single precision."""


@dataclass(frozen=True, slots=True)
class Comparison:
    """Result of comparing the kinematics of one external function with pytorch-kinematics.

    Attributes:
        name: name of the function.
        distance: largest difference of a coordinate between the two packages, in metres; None if not
            compared.
        why: reason for not comparing.
    """

    JSON: ClassVar = "name distance_m=distance why_not"

    name: str
    distance: float | None
    why: str = ""

    @property
    def why_not(self) -> str | None:
        """Reason for not comparing; None if there is none."""
        return self.why or None


def compared(function: FunctionDecl, *, seed: int = 0) -> Comparison:
    """Compare forward kinematics with pytorch-kinematics at random joint positions.

    Args:
        function: an external function of the kind `urdf`.
        seed: seed of the joint positions, which are uniform in [-pi, pi] rad or m.

    Raises:
        SystemFileError: S208, the two positions differ.
    """
    assert function.body is not None
    if find_spec("pytorch_kinematics") is None:
        return Comparison(function.name, None, f"{LIBRARY} is not installed (extra `panda`)")
    q = np.random.default_rng(seed).uniform(-np.pi, np.pi, (POSITIONS, len(function.body.formals)))
    nowhere = io.StringIO()  # for the library's messages about tags that it ignores
    try:
        with redirect_stdout(nowhere), redirect_stderr(nowhere), catch_warnings(action="ignore"):
            theirs = _by_library(function, q)
    except Exception as error:  # any error about a description that it does not support
        return Comparison(function.name, None, f"{LIBRARY} does not take it: {type(error).__name__}")
    args = tuple(ir.Signal(f"a{index}") for index in range(q.shape[1]))
    program = ArrayProgram({str(i): call for i, call in enumerate(function.body.calls_of("f", args))})
    found = program({"": q[:, 0], **{arg.name: q[:, i] for i, arg in enumerate(args)}})
    ours = np.stack([np.broadcast_to(found[str(i)], len(q)) for i in range(3)], 1)
    far = float(np.abs(ours - theirs).max())
    if not far <= _NEAR * max(1.0, float(np.abs(ours).max())):
        raise SystemFileError.of(
            "S208",
            f"`{function.name}` is up to {far:.2g} m from where {LIBRARY} puts `{function.attribute}`",
            function.span,
            "named here",
            note=("one of the two reads the description otherwise; compare origins, axes and `base`",),
        )
    return Comparison(function.name, far)


def _by_library(function: FunctionDecl, q: Doubles) -> Doubles:
    import pytorch_kinematics

    text = read_urdf(function.module).encode() if not isinstance(function.module, str) else b""
    arguments = (function.attribute, function.base) if function.base else (function.attribute,)
    chain = pytorch_kinematics.build_serial_chain_from_urdf(text, *arguments).to(dtype=torch.float64)
    found: Doubles = chain.forward_kinematics(torch.from_numpy(q)).get_matrix()[:, :3, 3].numpy()
    return found
