"""Judge of the two offices: judge.py trace.npz (dt 5 min, 169 samples; degrees Celsius and kWh)."""

import sys

import numpy as np

d = np.load(sys.argv[1], allow_pickle=False)
t1, t2, on, starts, used = (np.atleast_2d(d[name]) for name in ("t1", "t2", "on", "starts", "used"))
on = on > 0.5
e = 1e-6


def comfortable(t: np.ndarray, first: int, last: int) -> np.ndarray:
    """Rows that are comfortable from the hour `first` to the hour `last`."""
    part = t[:, 12 * first : 12 * last + 1]
    return ((part >= 20.5 - e) & (part <= 23.5 + e)).all(1) & (t.shape[1] > 12 * last)


def lasts(state: np.ndarray, samples: int) -> np.ndarray:
    """Rows in which each change to `state` until 13 h is followed by `samples` samples of it."""
    rows, when = np.nonzero(state[:, 1:157] & ~state[:, :-1][:, :156])
    ok = np.ones(len(state), bool)
    for row, k in zip(rows, when + 1, strict=True):
        ok[row] &= state[row, k : k + samples + 1].all() and k + samples < state.shape[1]
    return ok


rules = {
    "limits": ((np.minimum(t1, t2) >= 14 - e) & (np.maximum(t1, t2) <= 25 + e)).all(1),
    "morning": comfortable(t1, 4, 8) & comfortable(t2, 4, 8),
    "afternoon": comfortable(t1, 9, 13),
    "runs": lasts(on, 6),
    "rests": lasts(~on, 4),
    "few": (starts <= 5 + e).all(1),
    "thrift": (used[:, 168:169] <= 34 + e).all(1) & (used.shape[1] >= 169),
}
for name, held in rules.items():
    print(f"{name:16} {held.sum()} of {len(held)}")
print("all", np.logical_and.reduce(list(rules.values())).sum(), "of", len(t1))
