"""Evaluation of robustness on arrays, with any array library."""
