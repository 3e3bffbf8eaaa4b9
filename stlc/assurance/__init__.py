"""Evidence for and against a controller: searches for violations, and bounds on their probability."""
