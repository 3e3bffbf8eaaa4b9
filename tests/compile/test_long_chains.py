"""Long flat chains go through every part that reads a specification."""

from __future__ import annotations

import numpy as np
import pytest
import torch

import stlc
from stlc.grammar.english import sentence
from stlc.grammar.format.format import format_text
from stlc.grammar.spec import Spec
from stlc.lint.lint import lint
from stlc.source import Source


@pytest.mark.parametrize("count", [150, pytest.param(10_000, marks=pytest.mark.slow)])
@pytest.mark.parametrize(
    ("sign", "value"),
    [
        ("and", lambda terms: terms.min()),
        pytest.param("or", lambda terms: terms.max(), marks=pytest.mark.apart),
        ("+", lambda terms: terms.sum()),
    ],
)
def test_a_long_chain_is_judged_like_a_short_one(sign, value, count):
    terms = [f"{k % 7} - x" if sign == "+" else f"x < {k % 7}" for k in range(count)]
    body = f" {sign} ".join(f"({term})" for term in terms) + (" > 0" if sign == "+" else "")
    source = Source("long.stl", f"signal x\nrequire r: always[0 s, 1 s] ({body})\n")
    assert [one for one in lint(source) if one.severity == "error"] == []
    formatted = format_text(source)
    assert Spec.parse(Source("long.stl", formatted)) == Spec.parse(source)
    assert sentence(Spec.parse(source).items[1])
    x = np.array([1.0, 2.5, 3.0])
    expected = min(value(np.arange(count) % 7 - one) for one in x[:2])
    monitor = stlc.Monitor(source.text, dt=1)
    assert monitor.robustness({"x": x}, at=0) == pytest.approx(expected)
    tensor = torch.tensor(x, requires_grad=True)
    found = monitor.robustness({"x": tensor}, at=0)
    found.backward()
    assert float(found.detach()) == pytest.approx(expected)
    assert torch.isfinite(tensor.grad).all()
