"""Scenarios, and systems that differ from their model."""
