"""Proofs that the plans of a trained policy satisfy the specification on sets of initial states."""
