"""Settings of every test: one torch thread, reproducible hypothesis, no settings from outside."""

from __future__ import annotations

import gc
import os
import signal
import sys
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path

import pytest
from hypothesis import HealthCheck, settings

from stlc.__main__ import GARBAGE

TESTS = Path(__file__).parent
if find_spec("torch") is None:  # the base installation
    pytest_plugins = ["helpers.light"]

os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("MPLBACKEND", "Agg")
os.environ["COLUMNS"] = "100"  # layout must not depend on the terminal that runs the tests
for _name in ("NO_COLOR", "FORCE_COLOR", "CLICOLOR_FORCE", "PY_COLORS"):
    os.environ.pop(_name, None)
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)  # hundreds of tests start the program
sys.dont_write_bytecode = False

if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:  # as shells start what runs in the background
    signal.signal(signal.SIGINT, signal.default_int_handler)

settings.register_profile(
    "stlc",
    max_examples=15,
    deadline=None,
    derandomize=True,
    print_blob=True,
    suppress_health_check=[HealthCheck.too_slow],
)
settings.register_profile("explore", parent=settings.get_profile("stlc"), max_examples=200, derandomize=False)
settings.load_profile("explore" if os.environ.get("STLC_EXPLORE") else "stlc")


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--regenerate", action="store_true", help="write the golden files anew")


def pytest_collection_finish() -> None:
    """Modules and test items, some 600,000 objects, are not searched for garbage again and again."""
    gc.collect()
    gc.freeze()
    gc.set_threshold(*GARBAGE)


def pytest_unconfigure() -> None:
    """A single search for garbage at the end: pytest and the end of the process would search again."""
    gc.collect()
    gc.freeze()


SMALL = {
    "stlc.controller.training.learner.MARGIN_STATES": 8,
    "stlc.controller.training.learner.EFFORTS": (1000, 2000, 4000),
    "stlc.controller.search.conflict.JUDGED": 1000,
    "stlc.controller.search.conflict.TRIES": 1000,
    "stlc.controller.evaluation.held_out.KNOWN_FEASIBLE_TRIES": 1000,
    "stlc.controller.evaluation.held_out.JUDGED": 1000,
    "stlc.controller.search.feasibility.TRIES": 1000,
    "stlc.controller.evaluation.deployment.LATENCY_SECONDS": 0.01,
}
"""Sizes of searches in tests; with the usual ones the least training takes .5 s, and a simulation 5 s."""
ROUNDS = {"pool": 128, "most": 32}
"""States of a search round."""
TRAINING = {
    *("assurance", "benchmarks", "cli", "controller", "examples", "export", "gym", "runtime", "view"),
    *("test_hostile_runs.py", "test_plugins.py"),
}
"""Parts of the tests that train and simulate."""


@pytest.fixture(scope="module", autouse=True)
def _small_runs(request: pytest.FixtureRequest):
    with pytest.MonkeyPatch.context() as patch:
        if find_spec("torch") and request.path.relative_to(TESTS).parts[0] in TRAINING:
            from stlc.controller.training import loop

            decided = loop.resolve_config
            patch.setattr(loop, "resolve_config", lambda *options: replace(decided(*options), **ROUNDS))
            for name, value in SMALL.items():
                patch.setattr(name, value)
        yield


@pytest.fixture(autouse=True)
def _one_torch_thread() -> None:
    """Two threads beside a busy process are ten times slower than one."""
    torch = sys.modules.get("torch")
    if torch is not None and torch.get_num_threads() != 1:
        torch.set_num_threads(1)


@pytest.fixture(autouse=True)
def _kernels_are_asked_for_again(request):
    """A test that hides the compiler leaves no "there is no kernel" behind for the next one."""
    yield
    module = sys.modules.get("stlc.compile.backends.array.kernel")
    if module is not None and "monkeypatch" in request.fixturenames:
        module.kernel_library.cache_clear()
