"""Semantics selected by `--robustness` and `semantics=`: one file each, registered in `SEMANTICS`."""
