"""Schedule of an evaluation: the sub-formulas, and the instants at which their values are needed."""
