"""Linter: findings in valid specifications, unclear, unused or unusual."""
