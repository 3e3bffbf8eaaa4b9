"""Front end: from the syntax tree to a typed specification, with names, units, types and times checked."""
