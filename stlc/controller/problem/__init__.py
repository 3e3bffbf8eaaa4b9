"""Tasks: specification and system joined, and their native kernels."""
