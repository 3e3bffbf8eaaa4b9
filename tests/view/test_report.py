"""The report: whole by itself, complete, and harmless whatever stands in the files."""

import base64
import json
import os
import re
from dataclasses import replace
from html import unescape
from html.parser import HTMLParser

import pytest

import stlc.view
from stlc.controller.evaluation.metrics import METRICS
from stlc.diagnostics import MissingError, RunError
from stlc.rundir import RunDir
from stlc.view.contents import read_contents
from stlc.view.deployment import deployment_section
from stlc.view.report import render_report, repeat_section, sections_of, write_report

VOID = {"meta", "img", "br", "hr", "input"}


class Page(HTMLParser):
    """Anchors, images and text of a page; fails where a tag is not closed."""

    def __init__(self, html):
        super().__init__()
        self.open, self.ids, self.links, self.images, self.tags, self.text = [], [], [], [], set(), ""
        self.feed(html)
        self.close()
        assert not self.open

    def handle_starttag(self, tag, attrs):
        attrs = dict(attrs)
        self.tags.add(tag)
        self.ids += [attrs["id"]] if "id" in attrs else []
        self.links += [attrs["href"]] if "href" in attrs else []
        self.images += [attrs] if tag == "img" else []
        if tag not in VOID:
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        if self.open and self.open[-1] != "style":
            self.text += data


@pytest.fixture
def undrawn(monkeypatch):
    """Pages whose pictures are empty, where the text matters."""
    monkeypatch.setattr("stlc.view.style.Picture.svg", lambda _: "<svg/>")


def page_of(run):
    """The page alone, without the pictures beside it."""
    return Page(text_of(run))


def text_of(run):
    contents = read_contents(run)
    return render_report(contents, sections_of(contents))


@pytest.mark.usefixtures("undrawn")
def test_a_trained_run(trained):
    page = page_of(trained)
    assert page.ids == ["requirements", "failures", "training", "repeat", "texts"]
    assert page.links == [f"#{anchor}" for anchor in page.ids]
    assert "The policy's plan satisfies traffic from 95.7 % of 5,000 held-out starts" in page.text
    assert "95.1 to 96.2 %" in page.text
    assert "98.8 %" in page.text
    assert "require stop_sign: sign == stop -> eventually[0, T] tau >= 1 s" in page.text
    assert "5,900 steps (a budget of 60 s)" in page.text
    assert "0123456789ab, with uncommitted changes" in page.text
    command = (
        "stlc train specs/traffic.stl --system examples/car.yaml --seed 0 --steps 5900 --set 'T_red=3 s'"
    )
    assert command in page.text
    assert (trained.path / "spec.stl").read_text() in page.text
    assert (trained.path / "system.yaml").read_text() in page.text


@pytest.mark.usefixtures("undrawn")
def test_a_run_with_falsification_is_repeated_with_it(trained):
    record = trained.record()
    record["options"] = {**(record.get("options") or {}), "falsify": True}
    record["schedule"] = "5900,simulations=6@1500"
    trained.write_json("run.json", record)
    text = page_of(trained).text
    assert "--seed 0 --steps 5900,simulations=6@1500 --falsify" in text


def test_units_of_robustness_are_those_of_the_specification(trained):
    assert read_contents(trained).units == {
        "no_collision": "m"
    }  # the others compare more than one kind of thing
    (trained.path / "spec.stl").write_text("require (")
    assert read_contents(trained).units == {}


@pytest.mark.apart
def test_a_deployed_run(deployed):
    html = write_report(deployed).read_text(encoding="utf-8")
    page = Page(html)
    anchors = ["requirements", "deployment", "driven", "failures", "training", "repeat", "texts"]
    assert page.ids == ["film", "animation-data", *anchors]
    assert "2 seeds of 10 agents, 150 steps each" in page.text
    assert "98.1 % ± 1.2" in page.text
    assert "4.00 ± 0.10 m/s" in page.text
    assert "of which T0=1" in page.text
    assert "0.6 ms" in page.text
    assert "Violations and their causes" in page.text
    assert "before_junction means x < x_inter / 2" in page.text
    assert "stlc check" in page.text
    assert "Violations in this animation" in page.text
    drawn = {path.name for path in deployed.path.glob("*.png")}
    assert drawn == {"driven.png", "failures.png", "training.png"}
    kinds = [image["src"].partition(";")[0] for image in page.images]
    assert kinds == ["data:image/webp", *["data:image/svg+xml"] * 3]
    assert all(image["alt"] for image in page.images)
    assert_it_needs_nothing_from_outside(page, html)


def assert_it_needs_nothing_from_outside(page, html):
    assert not page.tags & {"link", "iframe", "object", "embed", "form"}
    assert "default-src 'none'" in unescape(html)
    assert not re.search(r"""(?:src|href)\s*=\s*["'](?!data:|#|[\w-]+\.gif["'])""", html)
    assert "url(" not in html
    for image in page.images:
        content = base64.b64decode(image["src"].partition("base64,")[2])
        if "svg" in image["src"][:20]:
            assert b"<script" not in content
            assert not re.search(rb'href="(?!#|data:)', content)


@pytest.mark.apart
@pytest.mark.usefixtures("undrawn")
def test_hostile_texts_stay_texts(trained):
    def hostile(place):
        return f"</pre><script>alert('{place}')</script><img src=x onerror=alert('{place}')>"

    keys = ("spec", "system", "spec_path", "system_path", "started", "device")
    names = ("spec.stl", "system.yaml", "compiled.txt", "config.resolved.yaml")
    record = trained.record() | {key: hostile(key) for key in keys}
    record["versions"] = {hostile("package"): hostile("version")}
    record["result"]["requirements"] = {hostile("requirement"): 0.5}
    trained.write_json("run.json", record)
    for name in names:
        path = trained.path / name
        path.write_text((path.read_text() if path.exists() else "") + f"\n# {hostile(name)}\n")
    html = text_of(trained)
    assert "<script" not in html
    assert "<img src=x" not in html
    for place in (*names, "spec", "system_path", "requirement", "version"):
        assert hostile(place) in Page(html).text, place


@pytest.mark.usefixtures("undrawn")
def test_what_is_damaged_or_missing_is_left_out(deployed):
    (deployed.path / "trace.npz").write_bytes(b"not an archive")
    (deployed.path / "eval/simulate.json").unlink()
    (deployed.path / "eval/held_out.npz").write_bytes(b"PK")
    (deployed.path / "spec.stl").write_text("require ((")
    (deployed.path / "system.yaml").unlink()
    page = page_of(deployed)
    assert page.ids == ["requirements", "training", "repeat", "texts"]
    assert "stop_sign" in page.text


@pytest.mark.usefixtures("undrawn")
def test_a_trace_of_another_specification_says_so(deployed, recording):
    meta = replace(recording.meta, spec_text="spec other\nsignal z [m]\nrequire r: always[0, T] z > 0\n")
    replace(recording, meta=meta).save(deployed.path / "trace.npz")
    os.utime(deployed.path / "traffic.gif")
    page = page_of(deployed)
    assert "The trace could not be judged" in page.text
    assert "`z`" in page.text


def test_a_run_that_has_just_begun(tmp_path):
    run = RunDir.create(tmp_path, "traffic", "new")
    run.write_json("run.json", {"status": "running", "spec": "traffic"})
    page = page_of(run)
    assert page.ids == ["training", "repeat"]
    assert "Training of traffic is running" in page.text


def test_a_folder_that_is_no_run(tmp_path):
    with pytest.raises(RunError):
        write_report(RunDir(tmp_path))


def test_without_matplotlib_the_reason_is_given(trained, monkeypatch):
    monkeypatch.setattr(stlc.view, "find_spec", lambda _: None)
    with pytest.raises(MissingError, match="R301"):
        write_report(trained)
    assert not (trained.path / "report.html").exists()


@pytest.mark.usefixtures("undrawn")
def test_every_metric_of_a_deployment_is_shown(deployed):
    for name in ("trace.npz", "eval/held_out.npz"):
        (deployed.path / name).unlink()
    document = json.loads((deployed.path / "eval/simulate.json").read_text())
    metrics = document["guards"]["paper"]["metrics"]
    for index, name in enumerate(metrics):
        metrics[name] = {"mean": 0.100 + index / 1000, "low": None, "high": None, "values": []}
    deployed.write_json("eval/simulate.json", document)
    text = page_of(deployed).text
    for index, name in enumerate(metrics):
        shown = (
            f"{0.1 + index / 1000:.3g}"
            if name in ("mean_speed", "junctions_passed", "overlapping_pairs")
            else None
        )
        assert (shown or f"{10 + index / 10:.1f} %") in text


def part_of(run, section):
    """The text of a section alone."""
    return Page(section(read_contents(run)).html).text


def test_a_world_that_no_plan_foresees_is_said(deployed):
    document = json.loads((deployed.path / "eval/simulate.json").read_text())
    text = part_of(deployed, deployment_section)
    assert "from 71.0 % of the starts; elsewhere it did what no plan could know" in text
    assert "the backup decided" in text
    assert "model-consistent, startsshare of starts" in text
    for guard in document["guards"].values():
        guard["metrics"]["foreseen"] = {"mean": 0.0, "low": 0.0, "high": 0.0, "values": [0.0, 0.0]}
        guard["decisions"] |= {"polished": 0.0, "backup": 0.0, "backup T0=1": 0.0}
    deployed.write_json("eval/simulate.json", document)
    text = part_of(deployed, deployment_section)
    assert "from no start; elsewhere" in text
    assert "model-consistent, starts" not in text  # a row of nothing
    assert "the backup decided" not in text
    assert "a polished plan" not in text


def test_the_head_counts_one_population_of_drives(deployed):
    """Drives of a simulation replace those of the training, and the scenario is named."""
    (deployed.path / "trace.npz").unlink()
    record = json.loads((deployed.path / "run.json").read_text())
    record["result"]["closed_loop"] = {"share": 1.0, "recommended": "none", "guards": []}
    deployed.write_json("run.json", record)
    document = json.loads((deployed.path / "eval/simulate.json").read_text())
    rules = {"full_stop": {"obeyed": 74, "broken": 26, "undecided": 0}}
    drives = {"count": 100, "safe": 80, "undecided": 0, "lost": 0, "told": 0, "rules": rules, "broken": []}
    for guard, obeyed in (("none", 42), ("paper", 74)):
        document["guards"][guard]["drives"] = drives | {"obeyed": obeyed}
    deployed.write_json("eval/simulate.json", document | {"judge": None, "scenario": "gusts"})
    contents = read_contents(deployed)
    head = Page(render_report(contents, [])).text
    assert (
        "In scenario gusts, 74 of 100 drives satisfied traffic at every instant; without the guard 42" in head
    )
    assert "74 of 100drives satisfied with the paper's guard" in head
    assert "of drives satisfied" not in head  # of those after the training
    shown = deployment_section(contents).html
    above, folded = shown.split("<details>")
    assert "80 of 100" in above
    assert METRICS["executed"].label in folded
    assert METRICS["executed"].label not in above
    (deployed.path / "eval/simulate.json").unlink()
    assert "100.0 %of drives satisfied" in Page(render_report(read_contents(deployed), [])).text


def test_the_deployment_can_be_repeated_as_it_was(deployed):
    def commands(**more):
        deployed.write_json("eval/simulate.json", document | more)
        return part_of(deployed, repeat_section)

    document = json.loads((deployed.path / "eval/simulate.json").read_text())
    assert f"stlc simulate {deployed.shown} --backup --seeds 0..1 --agents 10\n" in commands()
    told = {"steps": 70, "agents": 20, "time_limit": None, "margin": {"stop_sign": 0.2}, "ceiling": 0}
    text = commands(**told, scenario="mismatch-20", overrides={"T_red": "3 s"})
    words = "--backup --scenario mismatch-20 --seeds 0..1 --steps 70 --time-limit none --margin stop_sign=0.2"
    assert f"{words} --set 'T_red=3 s'\n" in text
    assert "--time-limit" not in commands(time_limit=0.1)
    assert "--time-limit 25ms" in commands(time_limit=0.025)
    assert "--time-limit 100ms" in commands(time_limit=0.1, paper_time_limit=0.1)
