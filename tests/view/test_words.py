"""Numbers as a reader wants them."""

import pytest

from stlc.view.words import (
    cause_words,
    count,
    interval,
    number,
    satisfied_sentence,
    seconds,
    share,
    spread,
    viable_sentence,
)


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (0.0006, "0.6 ms"),
        (0.0213, "21.3 ms"),
        (1.5, "1.5 s"),
        (61.2, "61.2 s"),
        (312.0, "5 min 12 s"),
        (300.0, "5 min"),
        (179.7, "3 min"),
        (None, ""),
    ],
)
def test_seconds(value, text):
    assert seconds(value) == text


@pytest.mark.parametrize(
    ("mean", "half", "text"),
    [
        (4.0, 0.1, ("4.00", "0.10")),
        (4.0, 4.1 - 4.0, ("4.00", "0.10")),
        (61.0, 3.2, ("61.0", "3.2")),
        (15.6, 11.3, ("16", "11")),
        (0.0, 0.0, ("0", "0")),
        (4.123, None, ("4.12", "")),
        (-2.5, 0.0123, ("-2.500", "0.012")),
    ],
)
def test_spread(mean, half, text):
    assert spread(mean, half) == text


def test_shares_and_counts():
    assert share(0.957) == "95.7 %"
    assert share(None) == ""
    assert share(1.0) == "100.0 %"
    assert share(0.9996) == "99.96 %"
    assert share(0.0002) == "0.02 %"
    assert interval([0.951, 0.9619]) == "95.1 to 96.2 %"
    assert interval(None) == ""
    assert count(1, "trace") == "1 trace"
    assert count(2000, "trace") == "2,000 traces"
    assert number(None) == ""
    assert number(23.54, "GiB") == "23.5 GiB"


def drives(obeyed, lost=0, undecided=0, count=200, told=0):
    each = {"count": count, "obeyed": obeyed, "lost": lost, "told": told, "undecided": undecided}
    return {"drives": each}


def test_how_many_drives_are_satisfied():
    guards = {"none": drives(181), "paper": drives(200)}
    simulation = {"spec": "traffic", "judge": {"spec": "driving_rules"}, "guards": guards}
    told = "200 of 200 drives satisfied driving_rules; without the guard 181"
    assert satisfied_sentence(simulation) == told
    assert viable_sentence(simulation) == ""
    windy = {**simulation, "scenario": "gusts"}
    assert satisfied_sentence(windy) == f"In scenario gusts, {told}"
    alone = {**simulation, "judge": None, "guards": {"none": drives(0, 1, 1, 1)}}
    assert satisfied_sentence(alone) == (
        "0 of 1 drive satisfied traffic at every instant, 1 ended too early to say"
    )
    assert viable_sentence(alone) == (
        "1 drive was lost from the start, where no plan is known: 0 of the 0 others satisfied it"
    )
    some = {**simulation, "guards": {"full": drives(190, 8)}}
    assert satisfied_sentence(some) == "190 of 200 drives satisfied driving_rules"
    assert viable_sentence(some) == (
        "8 drives were lost from the start, where no plan is known: 190 of the 192 others satisfied it"
    )
    told = {**simulation, "guards": {"full": drives(190, 10, told=2)}}
    assert viable_sentence(told) == (
        "8 drives were lost from the start, where no plan is known, and 2 were lost by an exogenous "
        "event after which no plan is known: 190 of the 190 others satisfied it"
    )
    only = {**simulation, "guards": {"full": drives(198, 1, told=1)}}
    assert viable_sentence(only).startswith("1 drive was lost by an exogenous event")


def test_why_a_rule_was_broken():
    def words(lost, why=None):
        return cause_words({"lost": lost, "cause": why and {"why": why, "time": 1.8}})

    assert words(True, "start") == words(True) == "lost from its start"
    assert words(False) == ""
    assert words(True, "told") == "lost at 1.8 s, by an exogenous event after which no plan is known"
    assert words(False, "later").startswith("no plan is known from 1.8 s on")
    assert words(False, "missed") == "a plan is known at 1.8 s, but another plan was followed"
