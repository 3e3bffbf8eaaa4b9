"""Planning without training: search for a plan from each given initial state."""
