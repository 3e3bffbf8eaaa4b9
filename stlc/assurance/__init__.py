"""Evidence about controllers beyond single verdicts: searches for violations, statistical bounds, certificates."""
