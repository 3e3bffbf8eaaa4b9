"""A run: its folder, options, checkpoint and policy."""
