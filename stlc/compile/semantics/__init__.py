"""Semantics of robustness: minima and maxima that are exact, smooth, or means."""
