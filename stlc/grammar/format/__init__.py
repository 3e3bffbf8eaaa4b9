"""Formatter of specifications."""
