"""Training: gradient steps, validation, search for plans, checkpoints."""
