"""The array namespace over torch."""
