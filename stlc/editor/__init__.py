"""Answers to an editor about a specification while it is written."""
