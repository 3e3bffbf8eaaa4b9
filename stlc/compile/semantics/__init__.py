"""Semantics of robustness: definitions of minimum and maximum that are exact, smooth, or based on means."""
