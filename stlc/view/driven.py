"""What was driven, judged: signals over robustness, and why a requirement was violated."""

from __future__ import annotations

from stlc.diagnostics import StlcError
from stlc.grammar.parser import parse
from stlc.monitor.verdict import Judgement, Monitor, Verdict
from stlc.source import Source
from stlc.view.highlight import spec_html
from stlc.view.html import Child, Html, classed, el, figure, join, table
from stlc.view.margins import Margins
from stlc.view.material import Material
from stlc.view.page import section
from stlc.view.signals import choose_traces, draw_signals
from stlc.view.style import ORANGE, RED
from stlc.view.words import count, share

Part = tuple[str, str, Html]
