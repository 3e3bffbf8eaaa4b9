"""Signal Temporal Logic in, a trained, checked and guarded controller out."""
