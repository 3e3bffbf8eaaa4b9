"""A task: specification and system joined, and its native kernels."""
