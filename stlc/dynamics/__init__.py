"""Hybrid systems declared in YAML."""
