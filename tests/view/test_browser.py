"""The report in a browser: nothing overflows, nothing is missing, both schemes can be read, no complaints."""

import json
import re
import shutil
import subprocess
from html import unescape
from itertools import product

import pytest

from stlc.view.report import write_report

CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
FRAMES = 4
"""Of the animation, as `conftest` has it."""
WIDTHS = {"desktop": 1280, "phone": 390}
PROBE = """<!doctype html><body><iframe src="report.html" width="%d" height="900"></iframe><script>
const frame = document.querySelector("iframe")
frame.onload = () => setTimeout(() => {
  const page = frame.contentDocument, look = x => frame.contentWindow.getComputedStyle(x)
  const all = [...page.body.querySelectorAll("*")], words = all.filter(x => [...x.childNodes].some(
    n => n.nodeType == 3 && n.textContent.trim()))
  document.body.dataset.found = JSON.stringify({
    wide: [page.documentElement.scrollWidth, page.documentElement.clientWidth],
    images: [...page.images].map(i => [i.naturalWidth, i.alt.length, i.getBoundingClientRect().width]),
    films: [...page.querySelectorAll("canvas")].map(c => [c.clientWidth, c.getAttribute("aria-label").length,
      new Set(c.getContext("2d").getImageData(0, 0, c.width, c.height).data).size]),
    clocks: [0.6, 1.1].map(share => {
      const slider = page.querySelector(".player input")
      slider.value = Math.round(share * slider.max)
      slider.dispatchEvent(new Event("input"))
      return page.querySelector(".player output").textContent
    }),
    jump: (() => {
      const button = page.querySelector("button[data-at]")
      button?.click()
      return [button?.dataset.at, page.querySelector(".player output").textContent]
    })(),
    smallest: Math.min(...words.map(x => parseFloat(look(x).fontSize))),
    paper: look(page.body).backgroundColor,
    inks: [...new Set(words.map(x => look(x).color))],
    anchors: [...page.querySelectorAll("nav a")].map(a => !!page.querySelector(a.getAttribute("href"))),
  })
}, 1500)
</script>"""

pytestmark = [pytest.mark.slow, pytest.mark.skipif(CHROMIUM is None, reason="there is no Chromium")]


@pytest.fixture
def written(deployed, recording):
    """A report with an animation."""
    recording.save(deployed.path / "trace.npz")
    write_report(deployed)
    return deployed.path


def opened(folder, width, scheme):
    """Findings of the browser, and its complaints."""
    probe = folder / "probe.html"
    probe.write_text(PROBE % width)
    done = subprocess.run(
        [
            *(CHROMIUM, "--headless=new", "--no-sandbox", "--disable-gpu", "--allow-file-access-from-files"),
            *("--enable-logging=stderr", "--virtual-time-budget=6000", "--window-size=1400,1000"),
            *(f"--blink-settings=preferredColorScheme={scheme}", f"--user-data-dir={folder / 'profile'}"),
            *("--dump-dom", probe.as_uri()),
        ],
        capture_output=True,
        text=True,
        timeout=120,
        check=True,
    )
    found = re.search(r'data-found="([^"]*)"', done.stdout)
    assert found, done.stderr[-2000:]
    complaints = [line for line in done.stderr.splitlines() if "CONSOLE" in line]
    return json.loads(unescape(found[1])), complaints


def luminance(color):
    channels = [int(part) / 255 for part in re.findall(r"\d+", color)[:3]]
    linear = [c / 12.92 if c <= 0.04045 else ((c + 0.055) / 1.055) ** 2.4 for c in channels]
    return 0.2126 * linear[0] + 0.7152 * linear[1] + 0.0722 * linear[2]


def contrast(a, b):
    low, high = sorted((luminance(a), luminance(b)))
    return (high + 0.05) / (low + 0.05)


def test_the_report_is_whole_and_legible_everywhere(written):
    papers = set()
    for (device, width), scheme in product(WIDTHS.items(), (0, 1)):
        found, complaints = opened(written, width, scheme)
        assert not complaints, (device, complaints)
        scrolled, visible = found["wide"]
        assert scrolled <= visible, device
        assert len(found["images"]) >= 3
        assert all(natural > 0 and words > 10 for natural, words, _ in found["images"])
        assert all(shown >= 600 for _, _, shown in found["images"]), "pictures keep their letters legible"
        ((wide, words, inks),) = found["films"]
        assert 300 < wide <= visible
        assert words > 10
        assert inks > 20  # something was painted
        assert found["clocks"] != ["0.0 s", "0.0 s"]
        at, clock = found["jump"]
        assert abs(float(at) - float(clock.split()[0])) <= 15 / FRAMES  # the nearest instant that is shown
        assert found["smallest"] >= 12
        assert all(found["anchors"])
        assert min(contrast(ink, found["paper"]) for ink in found["inks"]) >= 4.5, found["inks"]
        papers.add(found["paper"])
    assert len(papers) == 2  # light and dark
