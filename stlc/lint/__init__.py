"""What is worth saying about a specification that is valid: unclear, unused, unusual."""
