"""Evaluation of plans and of closed loops."""
