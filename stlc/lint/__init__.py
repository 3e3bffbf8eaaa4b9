"""Linter of specifications: errors, and warnings about unclear, unused or unusual parts."""
