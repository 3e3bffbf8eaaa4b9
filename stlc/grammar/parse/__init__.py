"""Text to syntax tree, by Lark."""
