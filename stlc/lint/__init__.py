"""Linter: findings in valid specifications, such as unclear, unused or unusual parts."""
