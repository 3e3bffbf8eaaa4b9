"""A trained controller taken away: as a torch program, as ONNX graphs, or as C."""
