"""What an editor asks of a specification while it is written."""
