"""Typed formulas, the intermediate representation, and what follows from them alone."""
