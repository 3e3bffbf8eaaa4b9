"""Back ends: from the intermediate representation to NumPy, torch, C and ONNX."""
