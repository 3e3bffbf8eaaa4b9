"""Evaluation and explanation of recorded traces."""
