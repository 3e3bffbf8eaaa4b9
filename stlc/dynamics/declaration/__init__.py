"""The sections of a system file: their records, and how they are read."""
