"""From a state to plans."""
