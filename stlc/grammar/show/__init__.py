"""Syntax trees as canonical text and as English."""
