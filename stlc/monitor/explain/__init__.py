"""Why a formula fails: causes, and words for them."""

from stlc.monitor.explain.report import explain

__all__ = ["explain"]
