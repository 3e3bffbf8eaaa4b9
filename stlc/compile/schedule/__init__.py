"""Schedule: values of sub-formulas and the instants at which they are needed."""
