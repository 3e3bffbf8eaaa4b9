"""Make `.venv` with stlc and its tools, unless it is up to date.

Runs under the system's Python with the standard library only. The syntax is old on purpose, so that an old
Python can still print the message that it is too old.
"""

import hashlib
import os
import subprocess
import sys
import time
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
VENV = ROOT / ".venv"
BIN = VENV / ("Scripts" if os.name == "nt" else "bin")
PYTHON = BIN / ("python.exe" if os.name == "nt" else "python")
STAMP = VENV / "stlc-stamp"
NEEDED = (3, 11)
INPUTS = ("pyproject.toml", "constraints.txt")
DEVELOPERS = "dev"


def fingerprint(extras):
    """Hash of the environment's inputs: extras, declared packages, Python version, path of the tree."""
    digest = hashlib.sha256()
    for name in INPUTS:
        digest.update((ROOT / name).read_bytes())
    digest.update(f"{extras} {sys.version} {ROOT}".encode())
    return digest.hexdigest()


def is_current(extras):
    """True if `.venv` was made for exactly this tree, with these extras or the developers' ones."""
    made = {fingerprint(extras), fingerprint(DEVELOPERS)}
    return PYTHON.exists() and STAMP.exists() and STAMP.read_text() in made


def ensure(extras=DEVELOPERS):
    """Make or update the environment if necessary; return the seconds taken. Exits on failure."""
    if sys.version_info < NEEDED:
        found = f"{sys.version_info[0]}.{sys.version_info[1]} at {sys.executable}"
        sys.exit(f"stlc needs Python 3.11 or newer, and this is {found}; try: make PYTHON=python3.11 demo")
    if is_current(extras):
        return 0.0
    started = time.monotonic()
    print("setting up .venv; the first time this takes about a minute", flush=True)
    if not has_same_python():
        run([sys.executable, "-m", "venv", "--clear", str(VENV)])
    pip = [str(PYTHON), "-m", "pip", "--disable-pip-version-check", "install", "--quiet"]
    run([*pip, "-c", "constraints.txt", "-e", f".[{extras}]"])
    STAMP.write_text(fingerprint(extras))
    return time.monotonic() - started


def has_same_python():
    """True if the Python in `.venv` runs and is the version of this one."""
    ask = [str(PYTHON), "-c", "import sys; print(sys.version)"]
    try:
        return subprocess.check_output(ask, text=True).strip() == sys.version
    except (OSError, subprocess.CalledProcessError):
        return False


def run(command):
    """Run one command in the tree's root; exits with a message if it fails."""
    code = subprocess.call(command, cwd=str(ROOT))
    if code:
        sys.exit(f"failed with exit code {code}: {' '.join(command)}")


if __name__ == "__main__":
    ensure()
