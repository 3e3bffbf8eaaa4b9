"""The terminal: arguments, one call, one rendering."""
