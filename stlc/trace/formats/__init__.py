"""Formats of trace files: a reader each, chosen by the suffix of the file."""
