"""Judge of the day of the farm: judge.py trace.npz (dt 15 min, 97 samples; SI units or kW and kWh)."""

import sys

import numpy as np

d = np.load(sys.argv[1], allow_pickle=False)
soc, charge, diesel, bill, fuel = (np.atleast_2d(d[n]) for n in ("soc", "charge", "diesel", "bill", "fuel"))
e = 1e-6
t = np.arange(soc.shape[1]) / 4
demand = np.interp(t, [0, 5, 7, 9, 12, 16, 18, 20, 22, 24], [1.5, 1.5, 4, 3, 3.5, 3, 6, 7, 3, 1.5])
sun = np.interp(t, [0, 6, 9, 12, 15, 19, 24], [0, 0, 4, 7, 5, 0, 0])
grid = demand - sun + charge - diesel


def hours(first: float, last: float) -> slice:
    """Samples of a part of the day."""
    return slice(round(4 * first), round(4 * last) + 1)


whole = soc.shape[1] >= 97
rules = {
    "battery": ((soc >= 2 - e) & (soc <= 19 + e) & (abs(charge) <= 5 + e)).all(1),
    "generator": ((diesel >= -e) & (diesel <= 4 + e)).all(1),
    "contract": ((grid >= -5 - e) & (grid <= 8 + e)).all(1),
    "evening": (grid[:, hours(17.5, 20.5)] <= 2 + e).all(1) & whole,
    "quiet": (diesel[:, hours(0, 6)] <= 0.1 + e).all(1)
    & (diesel[:, hours(22, 24)] <= 0.1 + e).all(1)
    & whole,
    "morning": (soc[:, hours(5, 7)] >= 14 - e).any(1),
    "refilled": (soc[:, hours(23.5, 24)] >= 10 - e).all(1) & whole,
    "cheap": (bill[:, 96:97] <= 8 + e).all(1) & (fuel[:, 96:97] <= 10 + e).all(1) & whole,
}
for name, held in rules.items():
    print(f"{name:16} {held.sum()} of {len(held)}")
print("all", np.logical_and.reduce(list(rules.values())).sum(), "of", len(soc))
