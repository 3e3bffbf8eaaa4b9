"""Front end: from the syntax tree to a typed specification, with names, units, sorts and times checked."""
