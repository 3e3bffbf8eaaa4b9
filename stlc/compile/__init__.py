"""Compiler: from the syntax tree of a specification to an intermediate representation and its back ends."""
