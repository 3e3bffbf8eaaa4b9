"""Specification language: concrete syntax, AST, parser, printer."""
