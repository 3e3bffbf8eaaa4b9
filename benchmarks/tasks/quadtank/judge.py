"""Judge of the four tanks: judge.py trace.npz (dt 3 s, 101 samples, levels in cm)."""

import sys

import numpy as np

d = np.load(sys.argv[1], allow_pickle=False)
h1, h2, h3, h4 = (np.atleast_2d(d[name]) for name in ("h1", "h2", "h3", "h4"))
e = 1e-6
first = (abs(h1 - 15) <= 0.5 + e) & (abs(h2 - 12) <= 0.5 + e)
second = (abs(h1 - 11) <= 0.5 + e) & (abs(h2 - 14) <= 0.5 + e)
low, high = np.minimum(h1, h2), np.maximum(h1, h2)
rules = {
    "overflow": ((high <= 18 + e) & (np.maximum(h3, h4) <= 8 + e)).all(1),
    "pumps_wet": (low >= 5 - e).all(1),
    "first": np.array([any(row[k : k + 11].all() for k in range(10, 51)) for row in first]),
    "second": second[:, 90:101].all(1) & (second.shape[1] >= 101),
}
for name, held in rules.items():
    print(f"{name:16} {held.sum()} of {len(held)}")
print("all", np.logical_and.reduce(list(rules.values())).sum(), "of", len(h1))
