"""Sections of a system file: a dataclass with the keys of each section, and the functions that read them."""
