"""Tables of the documentation: `python -m benchmarks` measures and writes them."""
