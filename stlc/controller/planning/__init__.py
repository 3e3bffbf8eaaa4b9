"""Planning: a plan for each of some given initial states, without training."""
