"""Back ends: translation of the intermediate representation to NumPy, torch, C, ONNX and MILP."""
