"""Causes of a violation, and their wording."""

from stlc.monitor.explain.report import explain

__all__ = ["explain"]
