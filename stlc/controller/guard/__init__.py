"""Runtime safety filters: plans are judged, and unsafe ones replaced."""
