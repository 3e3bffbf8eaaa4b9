"""ONNX back end: the computation as a graph."""
