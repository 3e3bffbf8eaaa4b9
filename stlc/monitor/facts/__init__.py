"""Facts that a verdict rests on: what was read, what was never triggered, and what looks odd in a recording.

`stlc.monitor.facts.rules` is the table of the rules, a function each.
"""
