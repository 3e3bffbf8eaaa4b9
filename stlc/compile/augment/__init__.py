"""State augmentation: states added to the system so that a plan knows the past of the mission."""
