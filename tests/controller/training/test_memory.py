"""Memory that is kept."""

from __future__ import annotations

import subprocess
import sys

import pytest

CODE = """
import resource
import torch
from stlc.controller.training.loop import keep_freed_memory

torch.set_num_threads(1)
assert keep_freed_memory() and keep_freed_memory()
def work():
    for _ in range(20):
        torch.zeros(400_000) + 1
work()
before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
work()
print(resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before)
"""


@pytest.mark.apart
@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="a setting of glibc")
def test_freed_memory_is_used_again_without_page_faults() -> None:
    done = subprocess.run([sys.executable, "-c", CODE], capture_output=True, text=True, check=True)
    assert int(done.stdout) < 2_000  # 20 times 1.6 MB are some 8,000 pages; one tensor may move once (390)
