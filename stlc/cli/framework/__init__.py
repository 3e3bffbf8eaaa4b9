"""What every command shares: the program, options, output, errors."""
