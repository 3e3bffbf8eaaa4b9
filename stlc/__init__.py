"""Signal Temporal Logic in, a trained, checked and guarded controller out."""

__version__ = "0.1.0"
