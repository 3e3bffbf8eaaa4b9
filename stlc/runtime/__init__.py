"""Runtime of an exported controller, with NumPy and onnxruntime alone.

from stlc.runtime import Controller

controller = Controller.load("controller", guard="paper")
decision = controller.decide(state)
"""

from stlc.runtime.controller import Controller, Decision, Guard

__all__ = ["Controller", "Decision", "Guard"]
