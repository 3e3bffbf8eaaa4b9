"""One formula, its text and a trace, all from one seed."""

from __future__ import annotations

import random
from typing import Any

import numpy as np
from proof.draw import DT, HORIZON, Drawing, Taste, rows, trace
from proof.language import Constant, Formula, nodes
from proof.levels import End, Record, ahead
from proof.written import specification

from stlc.grammar.printer import show
from stlc.grammar.spec import Spec
from stlc.monitor.verdict import Monitor
from stlc.source import Source


class Case:
    """A formula with everything that is needed to judge it."""

    def __init__(
        self, seed: int, taste: Taste | None = None, *, longest: int = 18, generic: bool = False
    ) -> None:
        rng = random.Random(seed)
        self.seed = seed
        self.formula: Formula = Drawing(rng, taste or Taste()).formula()
        self.text = specification(self.formula, rng)
        self.signals: dict[str, Any] = trace(rng, longest=longest, generic=generic)
        self.samples = len(self.signals["x"])
        self.rows = rows(self.signals)
        self.folds = any(isinstance(node, Constant) for node in nodes(self.formula))

    def monitor(self) -> Monitor:
        """Every other one from the text that stlc itself writes."""
        if self.seed % 2:
            return Monitor(self.text, dt=DT, horizon=HORIZON * DT)
        spec = Spec.parse(Source("<case>", self.text))
        again = Spec.parse(Source("<again>", show(spec)))
        assert again == spec, self
        return Monitor(again, dt=DT, horizon=HORIZON * DT)

    def record(self, end: End, until: int | None = None, stop: int | None = None) -> Record:
        """The trace up to a sample, with the signals of each sample in a row; `stop`: where it will end."""
        seen = self.rows if until is None else rows({name: x[:until] for name, x in self.signals.items()})
        return Record(seen, end, ahead(self.formula), stop or until or 0)

    def growing(self, until: int, end: End) -> Record:
        """The samples so far of a trace of which nobody knows where it ends."""
        seen = rows({name: x[:until] for name, x in self.signals.items()})
        return Record(seen, end, 2 * ahead(self.formula) + 8, until, growing=True)

    def columns(self) -> dict[str, Any]:
        """Column -> its values; a vector has one for each component."""
        found = {}
        for name, values in self.signals.items():
            if np.ndim(values) > 1:
                found |= {f"{name}[{k}]": values[:, k] for k in range(values.shape[1])}
            else:
                found[name] = values
        return found

    def __str__(self) -> str:
        requirement = self.text[self.text.index("region block") :].split("\n", 1)[1]
        return f"case {self.seed}: {requirement.strip()}\non {self.signals}"

    def same(self, found: Any, wanted: Any, about: str) -> None:
        """Equal within 1e-9, infinities and NaN included."""
        if not np.allclose(found, wanted, rtol=0, atol=1e-9, equal_nan=True):
            np.testing.assert_allclose(found, wanted, atol=1e-9, rtol=0, err_msg=f"{about}\n{self}")
