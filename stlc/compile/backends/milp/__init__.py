"""Mixed-integer linear back end: encodes the search for a plan of a piecewise linear system."""
