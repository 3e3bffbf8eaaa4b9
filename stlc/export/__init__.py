"""Export of a trained controller as a torch program, as ONNX graphs, or as C."""
