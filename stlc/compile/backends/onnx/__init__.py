"""ONNX graphs of what is computed."""
