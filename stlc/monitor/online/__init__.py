"""Samples one by one: verdicts as soon as they are decided, in bounded memory."""
