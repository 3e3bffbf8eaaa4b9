"""Semantics of robustness: extrema that are exact, smooth, or means."""
