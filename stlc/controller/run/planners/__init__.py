"""Planners of trained runs, one per file, beside those of `stlc.controller.search.planners`."""
