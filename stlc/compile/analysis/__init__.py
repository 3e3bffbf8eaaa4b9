"""Static analysis of a specification: what its ranges imply before it is used."""
