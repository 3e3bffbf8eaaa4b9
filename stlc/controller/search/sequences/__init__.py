"""Plans as sequences of phases: what is left to do, in which order, and a short search for each step."""
