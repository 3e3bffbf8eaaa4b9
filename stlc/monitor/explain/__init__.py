"""Causes of the violation of a requirement, and their description in words."""

from stlc.monitor.explain.report import explain

__all__ = ["explain"]
