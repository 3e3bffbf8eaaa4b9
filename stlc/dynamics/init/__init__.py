"""Drawing of initial states."""
