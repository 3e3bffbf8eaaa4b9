"""Tools to read sections: YAML nodes with source locations, records of keys, declared names, expressions."""
