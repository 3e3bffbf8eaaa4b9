"""Guards whose decisions rest on proofs, one per file."""
