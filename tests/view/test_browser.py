"""The report in a browser: nothing overflows, nothing is missing, both schemes can be read, no complaints."""

import json
import re
import shutil
import subprocess
from html import unescape
from itertools import product

import pytest
from PIL import Image

from stlc.trace import save_trace
from stlc.view.report import write_report
from stlc.view.video import encoder, video

CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
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
    videos: [...page.querySelectorAll("video")].map(v => [v.videoWidth, v.getAttribute("aria-label").length]),
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
    """A report with a film, a video where it can be."""
    if encoder() is not None:
        picture = Image.new("RGB", (320, 180), "white")
        with video(deployed.path / "traffic.mp4", picture.size, 100) as write:
            for _ in range(5):
                write(picture)
    save_trace(deployed.path / "trace.npz", recording)
    for name in ("traffic.gif", "traffic.mp4"):
        if (deployed.path / name).exists():
            (deployed.path / name).touch()  # newer than the trace
    write_report(deployed)
    return deployed.path


def opened(folder, width, scheme):
    """What the browser finds, and what it complains of."""
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
        assert all(shown >= 600 for _, _, shown in found["images"][1:]), "pictures keep their letters legible"
        if encoder() is not None:
            assert found["videos"] == [[320, pytest.approx(50, abs=40)]]
        assert found["smallest"] >= 12
        assert all(found["anchors"])
        assert min(contrast(ink, found["paper"]) for ink in found["inks"]) >= 4.5, found["inks"]
        papers.add(found["paper"])
    assert len(papers) == 2  # light and dark
