"""How fast the library is, as ratios that travel from one machine to another."""
