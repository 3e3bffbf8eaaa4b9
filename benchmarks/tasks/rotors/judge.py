"""Judge of the planar quadrotor: judge.py trace.npz (dt 0.05 s, 121 samples)."""

import sys

import numpy as np

d = np.load(sys.argv[1], allow_pickle=False)
x, z, tilt, vx, vz = (np.atleast_2d(d[name]) for name in ("x", "z", "tilt", "vx", "vz"))
e = 1e-6
there = (np.hypot(x - 5, z - 2) <= 0.3 + e) & (np.hypot(vx, vz) <= 0.5 + e)
rules = {
    "floor_": (z >= 0.3 - e).all(1),
    "upright": (abs(tilt) <= np.radians(70) + e).all(1),
    "hover": there[:, 80:121].all(1) & (x.shape[1] >= 121),
}
for name, held in rules.items():
    print(f"{name:16} {held.sum()} of {len(held)}")
print("all", np.logical_and.reduce(list(rules.values())).sum(), "of", len(x))
