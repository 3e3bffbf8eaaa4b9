"""The semantics that `--robustness` and `semantics=` name: a file each, its class under `SEMANTICS`."""
