"""State augmentation: added states (timers, latches, statuses) that carry the mission's past into a plan."""
