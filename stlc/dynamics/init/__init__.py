"""Where a system begins."""
