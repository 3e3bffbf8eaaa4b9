"""Robustness semantics, one file each: the values of `--robustness` and `semantics=`."""
