"""Judge of the ball and beam: judge.py trace.npz (dt 0.1 s, 181 samples)."""

import sys

import numpy as np

d = np.load(sys.argv[1], allow_pickle=False)
x, v, tilt = (np.atleast_2d(d[name]) for name in ("x", "v", "tilt"))
e = 1e-6


def rests(mark: float, first: int, last: int) -> np.ndarray:
    """Rows in which the ball rests at `mark` for 2 s from a sample between `first` and `last`."""
    near = (abs(x - mark) <= 0.03 + e) & (abs(v) <= 0.1 + e)
    return np.array(
        [any(row[k : k + 21].all() and k + 21 <= len(row) for k in range(first, last + 1)) for row in near]
    )


level = (abs(tilt) <= np.radians(2) + e) & (abs(v) <= 0.05 + e)
rules = {
    "on_beam": (abs(x) <= 0.5 + e).all(1),
    "shallow": (abs(tilt) <= np.radians(20) + e).all(1),
    "to_right": rests(0.3, 0, 60),
    "to_left": rests(-0.3, 90, 140),
    "level": level[:, 170:181].all(1) & (x.shape[1] >= 181),
}
for name, held in rules.items():
    print(f"{name:16} {held.sum()} of {len(held)}")
print("all", np.logical_and.reduce(list(rules.values())).sum(), "of", len(x))
