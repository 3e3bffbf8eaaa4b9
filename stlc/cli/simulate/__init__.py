"""`stlc simulate`."""
