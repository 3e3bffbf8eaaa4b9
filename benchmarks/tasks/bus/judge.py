"""Judge of the bus: judge.py trace.npz (dt 0.5 s, 241 samples)."""

import sys

import numpy as np

d = np.load(sys.argv[1], allow_pickle=False)
s, v, door = (np.atleast_2d(d[name]) for name in ("s", "v", "door"))
e = 1e-6
at = {stop: abs(s - stop) <= 1 + e for stop in (150, 340, 520)}
opened = door >= 0.9 - e


def called(stop: int, first: int, last: int) -> np.ndarray:
    """Rows with open doors at a stop for 5 s from a sample between `first` and `last`."""
    ok = at[stop] & opened
    return np.array(
        [any(row[k : k + 11].all() and k + 11 <= len(row) for k in range(first, last + 1)) for row in ok]
    )


def waits(line: float, first: int, last: int) -> np.ndarray:
    """Rows that do not cross a line at the samples from `first` to `last`."""
    over = s > line + e
    crossed = over[:, 1:] & (s[:, :-1] <= line - e)
    return ~crossed[:, first - 1 : last].any(1) & (s.shape[1] > last)


rules = {
    "limit": (v <= 13.9 + e).all(1),
    "doors": ((door <= 0.05 + e) | ((v <= 0.1 + e) & np.any([*at.values()], 0))).all(1),
    "light_1": waits(230, 76, 104),
    "light_2": waits(430, 160, 184),
    "call_market": called(150, 20, 56),
    "early": (s <= 151 + e)[:, :69].all(1) & (s.shape[1] >= 69),
    "call_school": called(340, 100, 152),
    "terminus": (at[520] & opened)[:, 228:241].all(1) & (s.shape[1] >= 241),
}
for name, held in rules.items():
    print(f"{name:16} {held.sum()} of {len(held)}")
print("all", np.logical_and.reduce(list(rules.values())).sum(), "of", len(s))
