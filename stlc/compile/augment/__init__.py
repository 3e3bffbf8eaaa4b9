"""State augmentation: states added to the system that store what happened earlier in the mission."""
