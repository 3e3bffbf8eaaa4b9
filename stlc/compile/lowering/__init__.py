"""From typed formulas to the intermediate representation, time in steps."""
