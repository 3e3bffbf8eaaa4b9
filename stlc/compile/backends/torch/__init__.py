"""Torch back end: array operations with gradients."""
