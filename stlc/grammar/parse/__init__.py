"""Parser from text to syntax tree, based on Lark."""
