"""Evaluation of recorded and growing traces, and explanation of violations."""
