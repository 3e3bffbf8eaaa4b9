"""Language support for editors: findings, hover, completion, rename."""
