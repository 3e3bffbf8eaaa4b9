"""Evidence about controllers beyond single verdicts: searches for violations, bounds, certificates."""
