"""YAML nodes with source locations, records of keys, names and expressions: tools to read sections."""
