"""The world of a deployment: what is true outside the model that the policy plans with.

A system file names one as `test: {world: "traffic_grid.py:TrafficGrid"}`: a class in a Python file beside it, imported
only when a deployment of that system is asked for. Without one, `ModelWorld` moves independent agents by the model
itself and lets the `events` of the file happen to them.
"""

from __future__ import annotations

import importlib.util
import sys
from collections.abc import Mapping
from pathlib import Path
from types import ModuleType
from typing import Any, ClassVar, Protocol, cast, runtime_checkable

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from stlc.compile.ops_torch import TORCH
from stlc.controller.events import Events
from stlc.diagnostics import Diagnostic, SystemFileError
from stlc.dynamics.decl import SystemDecl, WorldRef
from stlc.dynamics.system import System
