"""Lowering (translation) of typed formulas to the intermediate representation, with time in steps."""
