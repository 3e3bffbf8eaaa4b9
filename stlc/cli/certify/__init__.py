"""Statistical bounds in `stlc certify`, `simulate --certify` and `check --certify`."""
