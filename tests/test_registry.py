"""Names to plugins, and what is said about a name that is not there."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from fractions import Fraction
from pathlib import Path

import pytest
from helpers.effort import effort
from hypothesis import given
from hypothesis import strategies as st

from stlc.diagnostics import UsageError
from stlc.registry import PackageRegistry, Registry
from stlc.similar import closest

words = st.text("abcdefgh_", min_size=4, max_size=10)


@pytest.mark.parametrize(
    ("written", "candidates", "meant"),
    [
        ("saftey", ("safety", "liveness"), "safety"),
        ("v_leed", ("v", "v_lead", "x"), "v_lead"),
        ("integrater", ("dt", "horizon", "integrator", "substeps"), "integrator"),
        ("vlead", ("v_lead", "lead"), "v_lead"),
        ("Tau", ("tau", "tan"), "tau"),
        ("x", ("y", "v"), None),
        ("X", ("y", "x"), "x"),
        ("speed", ("x", "v", "sign"), None),
        ("anything", (), None),
        ("", ("a", "b"), None),
        ("same", ("same",), None),
        ("min_horizon", ("horizon", "policy"), "horizon"),
    ],
)
def test_closest(written, candidates, meant):
    assert closest(written, candidates) == meant


@given(words, st.data())
def test_one_slip_is_found_again(word, data):
    at = data.draw(st.integers(0, len(word) - 2))
    slip = data.draw(
        st.sampled_from(
            [
                word[:at] + word[at + 1 :],
                word[:at] + "z" + word[at:],
                word[:at] + "z" + word[at + 1 :],
                word[:at] + word[at + 1] + word[at] + word[at + 2 :],
            ]
        )
    )
    if slip != word:
        assert closest(slip, [word, "qqqqqqqqqqqqqqqqqq"]) == word


@given(words, st.lists(words, max_size=6))
def test_the_order_of_candidates_does_not_matter(word, candidates):
    assert closest(word, candidates) == closest(word, reversed(candidates))


def filled() -> Registry[int]:
    registry: Registry[int] = Registry("integrator")
    registry.register("euler")(1)
    registry.register("rk4")(4)
    return registry


def test_entries_are_kept_in_order():
    registry = filled()
    assert registry.names == ("euler", "rk4")
    assert list(registry) == ["euler", "rk4"]
    assert (registry.get("rk4"), len(registry), "euler" in registry, "heun" in registry) == (
        4,
        2,
        True,
        False,
    )


def test_the_decorator_gives_back_what_it_decorates():
    registry: Registry[object] = Registry("policy")

    @registry.register("one")
    def one() -> int:
        return 1

    assert one() == 1
    assert registry.get("one") is one


def test_a_name_is_taken_once():
    with pytest.raises(ValueError, match="integrator `rk4` is registered twice"):
        filled().register("rk4")(5)


def test_an_unknown_name_is_answered_with_the_nearest():
    with pytest.raises(UsageError) as caught:
        filled().get("eulr")
    (finding,) = caught.value.diagnostics
    assert finding.message == "unknown integrator `eulr`"
    assert finding.help == ("did you mean `euler`?  integrators: euler, rk4",)


def test_suggestions_without_a_neighbour():
    assert filled().suggest("leapfrog") == "integrators: euler, rk4"
    assert Registry[int]("world").suggest("x") == "there is no world"


def test_a_name_of_thousands_of_letters_is_a_slip_of_nothing():
    assert closest("xy", ["x" * 100_000, "x"]) == "x"
    assert closest("x" * 100_000, ["x", "x" * 99_999]) is None
    assert effort(lambda: closest("x" * 100_000, ["x", "x" * 99_999])) < 100


@pytest.fixture
def packages(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[tuple[str, str]]:
    """Two packages with plugins, one of them broken."""
    modules = {
        "below/zero.py": "ENTRY = Fraction(0)",
        "below/half.py": "ENTRY = Fraction(1, 2)",
        "below/_shared.py": "raise AssertionError",
        "above/ninth.py": "ENTRY = Fraction(1, 9)",
        "above/broken.py": "import surely_not_installed",
    }
    for name, text in modules.items():
        path = tmp_path / "numbers_of_tests" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(f"from fractions import Fraction\n{text}\n")
    monkeypatch.syspath_prepend(tmp_path)
    yield "numbers_of_tests.below", "numbers_of_tests.above"
    for name in [name for name in sys.modules if name.startswith("numbers_of_tests")]:
        del sys.modules[name]


def test_plugins_are_modules_of_several_packages(packages: tuple[str, str]) -> None:
    registry: PackageRegistry[Fraction] = PackageRegistry("number", packages, "ENTRY", default="zero")
    assert registry.names == ("zero", "broken", "half", "ninth")
    assert not any(name.startswith("numbers_of_tests") for name in sys.modules)
    assert registry.get("ninth") == Fraction(1, 9)
    with pytest.raises(UsageError, match="unknown number `nineth`"):
        registry.get("nineth")


def test_a_broken_plugin_is_no_fault_of_the_others(packages: tuple[str, str]) -> None:
    registry: PackageRegistry[Fraction] = PackageRegistry(
        "number", packages, "ENTRY", default="zero", order="denominator"
    )
    assert registry.names == ("zero", "half", "ninth", "broken")
    assert registry.loaded() == {"zero": 0, "half": Fraction(1, 2), "ninth": Fraction(1, 9)}
    with pytest.raises(ModuleNotFoundError, match="surely_not_installed"):
        registry.get("broken")
