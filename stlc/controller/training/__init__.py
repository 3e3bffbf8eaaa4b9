"""Training: steps, validation, search for plans, checkpoints."""
