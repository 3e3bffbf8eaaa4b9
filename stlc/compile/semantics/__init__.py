"""What the extremum of values means: exact, smooth, means."""
