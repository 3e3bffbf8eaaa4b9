"""Scenarios, and true systems that deviate from their model."""
