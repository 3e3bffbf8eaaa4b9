"""What is computed as an ONNX graph."""
