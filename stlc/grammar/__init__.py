"""What was written: concrete syntax, AST, parser, printer."""
