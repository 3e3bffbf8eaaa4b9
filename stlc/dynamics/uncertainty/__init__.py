"""Deviations of a true system from its model."""
