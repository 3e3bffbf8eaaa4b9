"""Benchmarks: `python -m benchmarks` measures the tables of the documentation and writes them."""
