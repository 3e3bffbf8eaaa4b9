"""Judge of the imaging satellite: judge.py trace.npz (dt 2 s; degrees, degrees a second, Nms)."""

import sys

import numpy as np

d = np.load(sys.argv[1], allow_pickle=False)
angle, rate, wheel = (np.atleast_2d(d[name]) for name in ("angle", "rate", "wheel"))
e = 1e-6


def points(target: float, first: int, last: int) -> np.ndarray:
    """Rows that point at `target` from the sample `first` to the sample `last`."""
    at = (abs(angle - target) <= 0.3 + e) & (abs(rate) <= 0.05 + e)
    return at[:, first : last + 1].all(1) & (at.shape[1] > last)


ground = abs(angle) <= 2 + e
rules = {
    "saturation": (abs(wheel) <= 0.5 + e).all(1),
    "gyro": (abs(rate) <= 2 + e).all(1),
    "camera": (abs(angle) <= 45 + e).all(1),
    "harbour": points(25, 25, 30),
    "dam": points(-20, 48, 52) | points(-30, 56, 60),
    "downlink": np.array(
        [any(row[k : k + 11].all() and k + 11 <= len(row) for k in range(70, 86)) for row in ground]
    ),
    "unloaded": (abs(wheel) <= 0.05 + e)[:, 98:101].all(1) & (wheel.shape[1] >= 101),
}
for name, held in rules.items():
    print(f"{name:16} {held.sum()} of {len(held)}")
print("all", np.logical_and.reduce(list(rules.values())).sum(), "of", len(angle))
