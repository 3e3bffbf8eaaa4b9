"""Framework of all commands: the program, options, output, errors."""
