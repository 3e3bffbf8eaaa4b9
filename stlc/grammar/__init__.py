"""Specification language: grammar, parser from text to syntax tree, formatter and printers."""
