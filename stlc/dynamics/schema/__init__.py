"""YAML with places, records of keys, names and expressions: what sections are read with."""
