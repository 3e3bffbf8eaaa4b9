"""How state moves: hybrid systems declared in YAML."""
