"""Formats of trace files, a module each."""
