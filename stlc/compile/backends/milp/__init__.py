"""Mixed-integer linear back end: plans of piecewise linear systems as a feasibility problem."""
