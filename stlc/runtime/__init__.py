"""Runtime of an exported controller; it needs only NumPy and onnxruntime.

from stlc.runtime import Controller

controller = Controller.load("controller", guard="paper")
decision = controller.decide(state)
"""

from stlc.runtime.controller import ControlDecision, Controller

Decision = ControlDecision
"""The former name of `ControlDecision`."""

__all__ = ["ControlDecision", "Controller", "Decision"]
