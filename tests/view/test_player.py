"""The animation of the report: what it holds, and that no text in it can leave it."""

import base64
import hashlib
import json
import re
from dataclasses import replace
from html import unescape

import numpy as np
import pytest

from stlc.rundir import RunDir
from stlc.trace import Trace
from stlc.view import player
from stlc.view.contents import read_contents
from stlc.view.report import render_report, write_report
from stlc.view.run_animation import WITH, WITHOUT, run_panels

WORLD = """
from stlc.controller.sketch import violations

class Dots:
    def reset(self): ...
    def advance(self, x, action): ...
    def progress(self): return {}
    def units(self): return {}
    def snapshot(self): ...
    @staticmethod
    def draw(axes, scene, index):
        axes.plot(scene["x"][index], 0 * scene["x"][index], "o", color="#0072b2")
        axes.text(5, 1, "</script><b>", color="#1f2430")
        violations(axes, np.stack((scene["x"][index], 0 * scene["x"][index]), 1), scene, index)
        axes.set(xlim=(0, 10), ylim=(-2, 2), aspect="equal")
        axes.set_axis_off()
import numpy as np
"""


@pytest.fixture
def compared(deployed, recording):
    """A run with a world, driven without and with the guard."""
    system = (deployed.path / "system.yaml").read_text()
    lines = [line for line in system.splitlines() if "world:" not in line]
    lines.insert(lines.index("test:") + 1, '  world: "dots.py:Dots"')
    (deployed.path / "system.yaml").write_text("\n".join(lines) + "\n")
    (deployed.path / "dots.py").write_text(WORLD)
    recording.save(deployed.path / "trace.npz")
    first = {name: rows[:10] for name, rows in recording.data.items()}
    replace(recording, data=first, extras={}).save(deployed.path / RunDir.UNGUARDED[0])
    scene = {"x": np.linspace(1, 9, 151)[:, None] + np.zeros(10)}
    decisions = np.concatenate((recording.extras["decision"][:10].T, np.zeros((1, 10))))
    np.savez(deployed.path / "scene.npz", **scene, decision=decisions.astype(np.int8))
    np.savez(deployed.path / RunDir.UNGUARDED[1], **scene, decision=np.zeros((151, 10), dtype=np.int8))
    return deployed


def data_in(html):
    return json.loads(re.search(r'id="animation-data">([^<]*)</script>', html)[1])


@pytest.mark.slow
def test_both_drives_are_shown_with_what_was_violated(compared):
    panels = run_panels(compared)
    assert [panel.title for panel in panels] == [WITHOUT, WITH]
    html = write_report(compared).read_text(encoding="utf-8")
    data = data_in(html)
    assert len(data["panels"]) == 2
    assert len(data["times"]) == len(data["panels"][0]["frames"]) == player.MOST_FRAMES
    assert all(len(row) == player.MOST_FRAMES for row in data["rows"])
    assert html.count("<canvas") == 2
    assert html.index("<canvas") < html.index('class="tiles"')  # the report begins with it
    assert len(html) < 5_000_000
    told = {(event.requirement, event.agent) for panel in panels for event in panel.events}
    verdicts = {name for name, _ in told}
    assert verdicts <= {"no_collision", "stop_sign", "give_way", "red_light"}
    assert verdicts
    jumps = [float(at) for at in re.findall(r'data-at="([^"]*)"', html)]
    assert jumps
    assert all(0 <= at <= 15 for at in jumps)
    event = panels[1].events[0]
    assert f"agent {event.agent}" in html
    assert "window from" in html


def test_the_page_runs_its_own_script_and_no_other_and_has_a_still_without_it(compared):
    html = render_report(read_contents(compared), [])
    scripts = re.findall(r"<script([^>]*)>(.*?)</script>", html, re.DOTALL)
    assert len(scripts) == 2
    (_, data), (attributes, code) = scripts
    assert json.loads(data)["panels"][0]["commands"]
    assert "\\u003c/script\\u003e\\u003cb\\u003e" in data  # what a world writes
    assert attributes == ""
    digest = base64.b64encode(hashlib.sha256(code.encode()).digest()).decode()
    assert f"script-src 'sha256-{digest}'" in unescape(html)
    assert "innerHTML" not in code
    assert "eval" not in code
    assert "fetch" not in code
    assert re.search(r'<noscript><img src="data:image/(?:png|webp);base64,', html)


@pytest.mark.parametrize("damage", ["no comparison", "another length", "a drawing that fails"])
def test_what_cannot_be_compared_is_shown_alone(compared, damage):
    match damage:
        case "no comparison":
            (compared.path / RunDir.UNGUARDED[1]).unlink()
        case "another length":
            np.savez(compared.path / RunDir.UNGUARDED[1], x=np.zeros((7, 10)), decision=np.zeros((7, 10)))
        case _:
            (compared.path / "dots.py").write_text(WORLD.replace('scene["x"][index], 0', 'scene["y"], 0'))
    (panel,) = run_panels(compared)
    assert panel.title == ""
    assert panel.frames == 151


def test_a_system_without_a_world_is_scrubbed_by_its_signals(deployed, recording):
    recording.save(deployed.path / "trace.npz")
    (panel,) = run_panels(deployed)
    assert panel.frames == recording.samples
    animation = panel.vector_frames(range(0, 151, 50))
    assert len(animation.frames) == 4
    words = {command[3] for command in animation.commands if command[0] == "t"}
    assert "v\n[m/s]" in words or {"v", "[m/s]"} <= words
    trace = Trace.load(deployed.path / "trace.npz")
    assert len(panel.names) == trace.traces
