"""Sections of a system file: their records and readers."""
