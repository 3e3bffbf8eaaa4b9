"""Closed loop: worlds, disturbances, events, and the agents in them."""
