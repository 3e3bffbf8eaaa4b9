"""A package with a plugin of each kind, a file each; `toy-1.0.dist-info` is what pip writes beside it."""
