"""`stlc train`."""
