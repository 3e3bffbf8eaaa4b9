"""Output of `stlc simulate`: its text, its progress and its live view."""
