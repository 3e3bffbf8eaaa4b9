"""Style of all pictures: few colours, colour-blind safe, legible on light and dark backgrounds.

Figures are made without pyplot, in the context `picture_style`. The global settings of matplotlib thus stay
unchanged.
"""

from __future__ import annotations

import base64
import io
import re
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from stlc.controller.sketch import SURROUNDINGS_ON_DARK, VIOLATED
from stlc.escape import lawful, visible
from stlc.files import File
from stlc.view import require_drawing

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# Okabe and Ito's colours, three greys, and a red far darker than their orange. `ON_DARK`: dark scheme.
INK, PAPER, MUTED, FAINT = "#1f2430", "#ffffff", "#6a7280", "#e4e7eb"
BLUE, ORANGE, GREEN, RED, SKY, PINK = "#0072b2", "#e69f00", "#009e73", VIOLATED, "#56b4e9", "#cc79a7"
ON_DARK = {
    INK: "#e6e8ec",
    PAPER: "#14171c",
    MUTED: "#9aa3b0",
    FAINT: "#2b3038",
    BLUE: "#5db3ec",
    ORANGE: "#f0b43c",
    GREEN: "#34c398",
    RED: "#ff6b66",
    SKY: "#8fd0f5",
    PINK: "#e39cc2",
}
SCENES_ON_DARK = ON_DARK | SURROUNDINGS_ON_DARK
SERIES = (BLUE, GREEN, PINK, SKY, ORANGE)  # requirements, in order; RED is kept for violations

_RC: Any = {
    "font.size": 8.5,
    "font.family": "DejaVu Sans",
    "text.hinting": "none",  # the layout measures texts as SVG draws them, else long labels are cut off
    "axes.titlesize": 9,
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "axes.labelsize": 8.5,
    "axes.edgecolor": MUTED,
    "axes.labelcolor": INK,
    "axes.titlecolor": INK,
    "axes.linewidth": 0.6,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "axes.facecolor": "none",
    "figure.facecolor": "none",
    "savefig.facecolor": "auto",
    "grid.color": FAINT,
    "grid.linewidth": 0.6,
    "text.color": INK,
    "xtick.color": MUTED,
    "ytick.color": MUTED,
    "xtick.labelsize": 7.5,
    "ytick.labelsize": 7.5,
    "xtick.major.size": 0,
    "ytick.major.size": 0,
    "lines.linewidth": 1.3,
    "lines.solid_capstyle": "round",
    "legend.frameon": False,
    "legend.fontsize": 8,
    "svg.fonttype": "path",
    "svg.hashsalt": "stlc",
    "text.parse_math": False,  # no TeX mode: a dollar sign in a name is literal
}


@contextmanager
def picture_style() -> Iterator[None]:
    """Context in which matplotlib has the settings for pictures.

    Raises MissingError (R301) if matplotlib or Pillow is not installed.
    """
    require_drawing()
    import matplotlib as mpl

    with mpl.rc_context(_RC), warnings.catch_warnings():
        for met in ("Glyph .* missing", "constrained_layout not applied"):  # names in other scripts, or long
            warnings.filterwarnings("ignore", message=met)
        yield


def new_figure(width: float, height: float) -> Figure:
    """Return an empty figure of the given size in inches.

    It must be called in the context `picture_style`.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def narrow_gaps(figure: Figure) -> None:
    """Reduce the gaps between the panels of a figure with many small panels."""
    from matplotlib.layout_engine import ConstrainedLayoutEngine

    engine = figure.get_layout_engine()
    if isinstance(engine, ConstrainedLayoutEngine):
        engine.set(h_pad=0.02, w_pad=0.06, hspace=0.03, wspace=0.03)


def hide_frame(axes: Axes) -> None:
    """Remove the frame, the grid and the labels of the ticks."""
    axes.grid(visible=False)
    axes.tick_params(labelbottom=False, labelleft=False)
    for spine in axes.spines.values():
        spine.set_visible(False)


@dataclass(frozen=True, slots=True)
class Picture:
    """A drawn figure and its description in words."""

    figure: Figure
    alt: str

    def svg(self) -> str:
        """Return the figure as SVG that follows the reader's light or dark scheme."""
        from matplotlib.text import Text

        buffer = io.StringIO()
        for text in self.figure.findobj(Text):
            text.set_text(lawful(text.get_text()))  # its comments may contain characters that XML forbids
        with picture_style():
            self._lay_out()
            self.figure.savefig(
                buffer, format="svg", transparent=True, metadata={"Date": None, "Creator": None}
            )
        return _themed(buffer.getvalue())

    def data_uri(self) -> str:
        """The SVG picture as a `data:` URI."""
        return "data:image/svg+xml;base64," + base64.b64encode(self.svg().encode()).decode()

    def save_png(self, path: Path, *, dpi: int = 150) -> Path:
        """Write the figure on a white background to `path` as PNG; return `path`."""
        with picture_style(), File(path).replaced() as beside:
            self._lay_out()
            self.figure.savefig(beside, format="png", dpi=dpi, facecolor=PAPER)
        return path

    def _lay_out(self) -> None:
        """Compute the layout once, since matplotlib would compute it twice for every saved file."""
        if self.figure.get_layout_engine() is not None:
            self.figure.draw_without_rendering()
            self.figure.set_layout_engine("none")


def _themed(svg: str) -> str:
    """Replace the colours in an SVG by CSS variables, which have values for the light and the dark scheme.

    The picture has a ground of its own, since a page may be dark where the reader's scheme is light.
    """
    inks = "|".join(ON_DARK)
    svg = re.sub(rf"({inks})\b", lambda ink: f"var(--c{ink[1][1:]})", svg[svg.index("<svg") :])
    light = ";".join(f"--c{ink[1:]}:{ink}" for ink in ON_DARK)
    dark = ";".join(f"--c{ink[1:]}:{other}" for ink, other in ON_DARK.items())
    ground = f"background:var(--c{PAPER[1:]})"
    sheet = f"<style>svg{{{light};{ground}}}@media(prefers-color-scheme:dark){{svg{{{dark}}}}}</style>"
    return svg.replace(">", f">{sheet}", 1)


LABEL = 60
"""Maximum number of characters of a label in a picture."""


def picture(text: str) -> str:
    """Return a label for a picture, truncated to `LABEL` characters.

    Matplotlib omits labels with a leading underscore from legends, so a thin space is put before the
    underscore.
    """
    words = visible(text if len(text) <= LABEL else f"{text[: LABEL - 1]}…")
    return f"\N{THIN SPACE}{words}" if words.startswith("_") else words
