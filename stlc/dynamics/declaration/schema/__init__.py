"""Tools to read sections: YAML nodes with locations, dataclasses of keys, declared names, expressions."""
