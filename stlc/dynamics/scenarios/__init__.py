"""Scenarios, and systems that deviate from their model."""
