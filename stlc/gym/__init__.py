"""A specification and a system as `gymnasium` environments, for training by other libraries.

`make` returns one environment; `make_vec` returns many, which are simulated as one batch in C. Importing this
package registers the six benchmarks with gymnasium: `gymnasium.make("stlc/traffic-v0")` and
`gymnasium.make_vec(…)`. The reward is computed from the specification, by default as the robustness of the
episode. The package needs the extras `gym` and `train`.
"""

from __future__ import annotations

from stlc.extras import explained

with explained():
    import gymnasium

    from stlc.gym.single import Reward, SpecEnv, make
    from stlc.gym.vector import SpecVectorEnv, make_vec

__all__ = ["BENCHMARKS", "Reward", "SpecEnv", "SpecVectorEnv", "make", "make_vec"]

BENCHMARKS = ("traffic", "reach_n_avoid", "ship_safe", "ship_track", "navigation", "manipulation")
"""Specifications that are registered, each as `stlc/NAME-v0`."""

for _name in BENCHMARKS:
    gymnasium.register(
        id=f"stlc/{_name}-v0",
        entry_point="stlc.gym.single:make",
        vector_entry_point="stlc.gym.vector:make_vec",
        kwargs={"spec": f"{_name}.stl"},
    )
