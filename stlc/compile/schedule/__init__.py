"""Which value of a formula is needed at which instant."""
