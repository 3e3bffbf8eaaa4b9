"""A system file read, checked, and turned into a declaration."""
