"""Static analysis of a specification: warnings that follow from its declared ranges."""
