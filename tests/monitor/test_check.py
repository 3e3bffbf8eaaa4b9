"""`stlc.check`: what its options are for."""

from __future__ import annotations

import pytest

import stlc
from stlc.monitor.check import OF_FILES, Question

SPEC = "spec s\nsignal x\nrequire a: always x > 0\n"


@pytest.mark.parametrize("name", sorted(OF_FILES))
def test_an_option_of_files_is_refused_for_arrays(name: str) -> None:
    given = {"x": [1.0, 2.0]}
    assert stlc.check(SPEC, given).status == "satisfied"
    with pytest.raises(stlc.StlcError, match=f"`{name}` is for files"):
        stlc.check(SPEC, given, **{name: getattr(Question(), name)})
