"""Rivals of the paper's comparison: training methods, a file each, with which no user needs to train.

`stlc train --method benchmarks/methods/sac.py` trains with one; `python -m benchmarks` knows all by name.
Code that several share lies in files whose names begin with `_`. The folder `planners` holds planners.
"""
