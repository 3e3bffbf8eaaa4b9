"""Formats of trace files, one module per format."""
