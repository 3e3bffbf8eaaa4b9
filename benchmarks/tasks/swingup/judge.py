"""Judge of the swing-up: judge.py trace.npz (dt 0.05 s, 161 samples)."""

import sys

import numpy as np

d = np.load(sys.argv[1], allow_pickle=False)
x, angle = (np.atleast_2d(d[name]) for name in ("x", "angle"))
e = 1e-6
rules = {
    "track": (abs(x) <= 2.4 + e).all(1),
    "upright": (np.cos(angle) >= 0.97 - e)[:, 100:161].all(1) & (x.shape[1] >= 161),
}
for name, held in rules.items():
    print(f"{name:16} {held.sum()} of {len(held)}")
print("all", np.logical_and.reduce(list(rules.values())).sum(), "of", len(x))
