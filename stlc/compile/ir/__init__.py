"""Typed formulas, the intermediate representation (IR), and analyses of both."""
