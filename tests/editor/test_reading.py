from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from stlc.editor.document import Systems, analyse, read
from stlc.source import Source

GOOD = "signal x [m]\nconst c = 2 m\nrequire a: x > c\nrequire b: always[0 s, 1 s] x > 0 m\n"


def names(text: str) -> list[str]:
    return [item.name for item in read(Source("t.stl", text))[0].items]


def test_a_good_text_is_read_whole():
    assert names(GOOD) == ["x", "c", "a", "b"]
    assert read(Source("t.stl", GOOD))[1] == ()


def test_what_cannot_be_read_is_left_out():
    text = GOOD.replace("x > c", "x > ")
    spec, findings = read(Source("t.stl", text))
    assert [item.name for item in spec.items] == ["x", "c", "b"]
    assert {finding.code for finding in findings} == {"E010"}


def test_places_stay():
    text = GOOD.replace("const c = 2 m", "const c = = 2 m")
    spec, _ = read(Source("t.stl", text))
    for item in spec.items:
        start = item.name_span.start
        assert text[start : start + len(item.name)] == item.name


def test_several_faults():
    assert names(GOOD.replace("x > c", "x > ").replace("[m]", "[mm m]")) == ["c", "b"]


def test_a_text_of_nothing_but_faults():
    assert names(") ( ]") == []
    assert names("") == []


@given(st.integers(0, len(GOOD)), st.sampled_from(["", "(", "]", "□", '"', "require", "\0", "always["]))
def test_never_fails(place, junk):
    spec, findings = read(Source("t.stl", GOOD[:place] + junk + GOOD[place:]))
    assert findings or len(spec.items) >= 4


@given(st.text(alphabet=GOOD + '@"`{}[]()', max_size=60))
def test_any_text(text):
    read(Source("t.stl", text))


def test_a_judge_of_drives_is_linted_as_one(tmp_path):
    system = (
        "stlc: 1\nname: cart\ntime: {dt: 0.2 s, horizon: 20 steps}\nstate: {x: {unit: m}}\nflow: {x: 1 m/s}\n"
        "control: {a: {range: [-1, 1]}}\ninit: {mixture: [{draw: {x: 0}}]}\ntest: {judge: rules.stl}\n"
    )
    (tmp_path / "cart.yaml").write_text(system)
    text = 'system "cart.yaml"\nstate signal x [m]\nrequire r: always x < 9 m\nrequire s: x < 3 m\n'
    (tmp_path / "rules.stl").write_text(text)
    found = {}
    for name in ("rules.stl", "plans.stl"):
        document = analyse(Source(str(tmp_path / name), text), Systems())
        found[name] = [one.diagnostic.code for one in document.findings]
    assert found["rules.stl"] == ["W311"]
    assert "W311" not in found["plans.stl"]
