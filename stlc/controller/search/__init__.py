"""Search for plans: what a plan may begin with, how it is changed, and when a search ends."""
