"""ONNX back end: rollout and robustness as an ONNX graph."""
