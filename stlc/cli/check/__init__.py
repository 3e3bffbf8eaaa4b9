"""The work of `stlc check`, and of `stlc explain` for a trace: read, judge and explain traces."""
