"""Judge of the trailer: judge.py trace.npz (dt 0.25 s, 181 samples)."""

import sys

import numpy as np

d = np.load(sys.argv[1], allow_pickle=False)
x, y, heading, trailer, v = (np.atleast_2d(d[name]) for name in ("x", "y", "heading", "trailer", "v"))
e = 1e-6
WALLS = ((-3, 1.6, 6, 4), (-3, -4, 6, -1.6), (-3, -1.6, -1, 1.6))


def behind(length: float) -> tuple[np.ndarray, np.ndarray]:
    """Point of the trailer behind its hitch."""
    return x - length * np.cos(trailer), y - length * np.sin(trailer)


def clear(px: np.ndarray, py: np.ndarray) -> np.ndarray:
    """Rows in which a point is 0.9 m from all walls."""
    away = [
        np.hypot(np.maximum(np.maximum(a - px, px - c), 0), np.maximum(np.maximum(b - py, py - f), 0))
        for a, b, c, f in WALLS
    ]
    return (np.min(away, 0) >= 0.9 - e).all(1)


ax, ay = behind(5)
rest = (
    (ax >= 1 - e)
    & (ax <= 2 + e)
    & (abs(ay) <= 0.3 + e)
    & (abs(trailer) <= np.radians(4) + e)
    & (abs(v) <= 0.05 + e)
)
rules = {
    "jackknife": (abs(heading - trailer) <= np.radians(50) + e).all(1),
    "walls_": clear(ax, ay) & clear(*behind(6)),
    "parked": np.array(
        [any(row[k : k + 17].all() and k + 17 <= len(row) for k in range(161)) for row in rest]
    ),
    "yard": ((x <= 30 + e) & (abs(y) <= 7 + e)).all(1),
}
for name, held in rules.items():
    print(f"{name:16} {held.sum()} of {len(held)}")
print("all", np.logical_and.reduce(list(rules.values())).sum(), "of", len(x))
