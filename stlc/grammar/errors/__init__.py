"""Syntax errors and their diagnostics."""
