"""Hybrid systems (continuous motion with discrete jumps), declared in YAML."""
