"""What "satisfied" means: numbers and formulas as one intermediate representation."""
