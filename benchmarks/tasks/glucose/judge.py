"""Judge of the glucose: judge.py trace.npz (dt 5 min, 121 samples, mg/dl)."""

import sys

import numpy as np

d = np.load(sys.argv[1], allow_pickle=False)
g = np.atleast_2d(d["g"])
e = 1e-6


def normal(first: float, last: float) -> np.ndarray:
    """Rows with 75 to 115 mg/dl from the hour `first` to the hour `last`."""
    part = g[:, round(12 * first) : round(12 * last) + 1]
    return ((part >= 75 - e) & (part <= 115 + e)).all(1) & (g.shape[1] > round(12 * last))


back = np.ones(len(g), bool)
for row, k in np.argwhere(g[:, :97] > 170 + e):
    back[row] &= (g[row, k : k + 13] <= 150 + e).any()
rules = {
    "no_hypo": (g >= 70 - e).all(1),
    "no_peak": (g <= 220 + e).all(1),
    "back": back,
    "lunch_ready": normal(4.5, 5),
    "evening": normal(9.5, 10),
}
for name, held in rules.items():
    print(f"{name:16} {held.sum()} of {len(held)}")
print("all", np.logical_and.reduce(list(rules.values())).sum(), "of", len(g))
