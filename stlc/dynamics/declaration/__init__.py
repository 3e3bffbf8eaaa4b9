"""A system file as data."""
