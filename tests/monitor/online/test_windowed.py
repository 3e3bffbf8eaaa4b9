"""Planning windows, sample by sample: bounds before the end are those of the samples so far."""

from __future__ import annotations

import numpy as np
import pytest

from stlc.monitor.verdict import Monitor

REQUIREMENTS = {
    "within": "always[0, T] (a > 0 or eventually[0, end] b > 0)",
    "swept": "eventually[0, T] sweep([a, b]) in block",
    "with_past": "always[0, T] (once[0 s, 0.2 s] a > 0 or eventually[0, end] b > 0)",
    "beyond": "eventually[0, T] a > 1 and always[0 s, 0.9 s] (b > -1 or eventually[0, end] a > 1)",
    "past_beyond": "(a < 1 release(T - 0.1 s, inf] a >= 1) until[0.2 s, 0.9 s] historically b > -2",
    "past_of_now_beyond": "(b > 0 release(T, inf] a >= 1) until[0 s, 0.8 s] (a > 1 since[0.1 s, inf] b > 0)",
    "short_past_beyond": "(b > 0 release(T, inf] a >= 1) until[0 s, 0.9 s] historically[0 s, 0.8 s] b > -1",
    "frozen_beyond": "always[0 s, 0.8 s] freeze c = a in once[0 s, 0.4 s] b > c or eventually[T, inf] b > 1",
}


@pytest.mark.parametrize("name", REQUIREMENTS)
@pytest.mark.parametrize("step", [1, 4])
def test_bounds_are_those_of_the_samples_so_far(name: str, step: int) -> None:
    text = f"signal a\nsignal b\nregion block = box([-1, -1], [1, 1])\nrequire r: {REQUIREMENTS[name]}\n"
    monitor = Monitor(text, dt=0.1, horizon=0.6)
    rng = np.random.default_rng(7)
    for _ in range(2 if step > 1 else 1):
        whole = {signal: rng.integers(-16, 16, 17) / 8 for signal in ("a", "b")}
        online = monitor.online()
        for k in range(0, 17, step):
            online.feed({key: values[k : k + step] for key, values in whole.items()})
            known = {key: values[: k + step] for key, values in whole.items()}
            low, high = monitor.bounds(known)
            tally = online.standing("r")
            assert (tally.low, tally.high) == (low[: tally.instants].min(), high[: tally.instants].min())
            opened = online.open_starts("r")
            assert opened
            for start, least, most in opened:
                assert (least, most) == (low[start], high[start]), (start, k)
        assert online.finish()["r"].low == monitor.check(whole)["r"].low[:, 0].min()
