"""A system that is not as its model says."""
