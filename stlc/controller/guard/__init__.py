"""Runtime safety filters: a plan is judged, and replaced where it is not safe."""
