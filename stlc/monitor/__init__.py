"""How a recorded trace is judged and explained."""
