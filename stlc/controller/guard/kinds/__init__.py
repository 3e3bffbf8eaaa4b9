"""Guards, one per file."""
