"""`stlc check` and `stlc explain` of traces."""
