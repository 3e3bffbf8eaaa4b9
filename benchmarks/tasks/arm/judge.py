"""Judge of the arm: judge.py trace.npz (dt 0.1 s; places 0 bin, 1 gripped, 2 placed)."""

import sys

import numpy as np

d = np.load(sys.argv[1], allow_pickle=False)
q1, q2, w1, w2, phase = (np.atleast_2d(d[name]) for name in ("q1", "q2", "w1", "w2", "phase"))
part = np.round(np.atleast_2d(d["part"])).astype(int)
e = 1e-6
ex, ey = np.cos(q1), np.sin(q1)
tx, ty = ex + 0.8 * np.cos(q1 + q2), ey + 0.8 * np.sin(q1 + q2)
hx = 0.2 + 0.4 * np.sin(phase)
near = np.minimum(np.hypot(tx - hx, ty - 1.2), np.hypot(ex - hx, ey - 1.2))
rest = (abs(q2) >= 2 - e) & (abs(w1) <= 0.2 + e) & (abs(w2) <= 0.2 + e)


def first(place: int) -> np.ndarray:
    """First sample at which the part is at a place; a large number if it never is."""
    there = part == place
    return np.where(there.any(1), there.argmax(1), 10**6)


rules = {
    "joints": ((q1 >= -0.2 - e) & (q1 <= 3.3 + e) & (abs(q2) <= 2.5 + e)).all(1),
    "hand_": (near >= 0.25 - e).all(1),
    "table": (ty >= 0.1 - e).all(1),
    "gentle": ((part != 1) | (abs(w1) <= 1 + e)).all(1),
    "pick": first(1) <= 80,
    "order": (first(1) <= 200) & (first(1) < first(2)),
    "place": (part == 2)[:, 80:201].any(1),
    "rest": rest[:, 230:241].all(1) & (rest.shape[1] >= 241),
}
for name, held in rules.items():
    print(f"{name:16} {held.sum()} of {len(held)}")
print("all", np.logical_and.reduce(list(rules.values())).sum(), "of", len(q1))
