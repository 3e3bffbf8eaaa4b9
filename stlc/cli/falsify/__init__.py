"""Parts of `stlc falsify`."""
