"""The commands of the program, a module or a package each."""
