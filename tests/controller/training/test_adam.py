"""Adam: the steps of `torch.optim.Adam`, without torch's compiler."""

from __future__ import annotations

import subprocess
import sys

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from stlc.controller.training.adam import Adam

ALONE = """
import sys
import torch
from stlc.controller.training.adam import Adam

weight = torch.ones(3, requires_grad=True)
adam = Adam([weight])
weight.sum().backward()
adam.step(0.1)
assert weight.detach().tolist() != [1.0, 1.0, 1.0]
print("torch._dynamo" in sys.modules)
"""


def weights(seed: int) -> list[Tensor]:
    generator = torch.manual_seed(seed)
    return [torch.randn(size, generator=generator).requires_grad_() for size in ((3, 2), (2,), (1,))]


@given(st.integers(0, 2**32 - 1), st.lists(st.floats(1e-5, 0.1), min_size=1, max_size=6))
@settings(max_examples=20)
def test_steps_are_those_of_torch(seed: int, rates: list[float]) -> None:
    """The last weight has no gradient in the first step; a copy continues from the tensors of each step."""
    ours, theirs = weights(seed), weights(seed)
    adam, reference = Adam(ours), torch.optim.Adam(theirs, fused=True)
    for number, rate in enumerate(rates):
        for group in reference.param_groups:
            group["lr"] = rate
        for here, there in zip(ours, theirs, strict=True):
            slope = torch.randn_like(here)
            here.grad, there.grad = slope, slope.clone()
        if number == 0:
            ours[-1].grad = theirs[-1].grad = None
        continued = Adam(ours)
        continued.restore(adam.tensors())
        adam = continued
        adam.step(rate)
        reference.step()
        for here, there in zip(ours, theirs, strict=True):
            assert torch.equal(here, there)
    known = reference.state_dict()["state"]
    assert adam.tensors().keys() == {f"{i}.{name}" for i, found in known.items() for name in found}
    adam.zero_grad()
    assert all(weight.grad is None for weight in ours)


@pytest.mark.apart
def test_a_step_does_not_import_the_compiler_of_torch() -> None:
    found = subprocess.run([sys.executable, "-c", ALONE], capture_output=True, text=True, check=True)
    assert found.stdout.strip() == "False"
