"""Output of `stlc train`: the panel, the final screen, several runs at once."""
