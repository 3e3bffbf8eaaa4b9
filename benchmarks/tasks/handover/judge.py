"""Judge of the two carts: judge.py trace.npz (dt 0.5 s; places 0 shelf, 1 first, 2 second, 3 done)."""

import sys

import numpy as np

d = np.load(sys.argv[1], allow_pickle=False)
ax, ay, bx, by = (np.atleast_2d(d[name]) for name in ("ax", "ay", "bx", "by"))
part = np.round(np.atleast_2d(d["part"])).astype(int)
speed = np.hypot(np.atleast_2d(d["avx"]), np.atleast_2d(d["avy"]))
e = 1e-6
u = np.linspace(0, 1, 201)
px = ax[:, :-1, None] + u * np.diff(ax)[..., None]
py = ay[:, :-1, None] + u * np.diff(ay)[..., None]
inside = (px > 2.5 + 1e-4) & (px < 4 - 1e-4) & (py > 4 + 1e-4) & (py < 5.5 - 1e-4)
sides = (ax >= 0.3 - e) & (ax <= 5.5 + e) & (bx >= 6.3 - e) & (bx <= 11.7 + e)
sides &= (np.minimum(ay, by) >= 0.3 - e) & (np.maximum(ay, by) <= 7.7 + e)
home = (np.hypot(ax - 1, ay - 1) <= 0.6 + e) & (np.hypot(bx - 11, by - 1) <= 0.6 + e)
rules = {
    "sides": sides.all(1),
    "apart": (np.hypot(ax - bx, ay - by) >= 0.9 - e).all(1),
    "bench_": ~inside.any((1, 2)),
    "careful": ((part != 1) | (speed <= 1 + e)).all(1),
    "pick": (part == 1)[:, :31].any(1),
    "deliver": (part == 3)[:, :81].any(1),
    "home": home[:, 140:151].all(1) & (ax.shape[1] >= 151),
}
for name, held in rules.items():
    print(f"{name:16} {held.sum()} of {len(held)}")
print("all", np.logical_and.reduce(list(rules.values())).sum(), "of", len(ax))
