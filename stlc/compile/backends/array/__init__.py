"""Robustness over any array library."""
