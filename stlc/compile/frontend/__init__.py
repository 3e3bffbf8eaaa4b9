"""From the syntax tree to a typed specification: names, units, sorts, times."""
