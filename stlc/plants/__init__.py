"""Plants from elsewhere: black boxes in Python, gymnasium and FMUs, in processes of their own."""
