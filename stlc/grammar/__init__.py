"""The language: concrete syntax, AST, parser, printer."""
