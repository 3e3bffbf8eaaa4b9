"""`stlc bench`."""
