"""The tests of the base installation: an environment without extras, its size, and the tests that need none.

Some of them run a second time in a Python that lacks what Windows lacks (`tests/portable`).
"""

import os
import shutil
import subprocess
import sys
import time

import environment

VENV = environment.ROOT / ".venv-light"
PYTHON = VENV / "bin/python"
LARGEST = 150
"""Megabytes that the installation may take, with pip."""
TOOLS = ("pytest", "pytest-xdist", "hypothesis", "jsonschema")
WITHOUT_TORCH = (
    *("tests/test_facade.py", "tests/test_extras.py", "tests/cli/commands", "tests/cli/framework"),
    *("tests/cli/test_bad_input.py", "tests/monitor/facts", "tests/runtime"),
)
PORTABLE = (
    *("tests/test_light.py", "tests/cli/test_commands.py", "tests/lint/test_lint.py"),
    *(f"tests/cli/commands/check/test_{name}.py" for name in ("check", "recordings", "uncertain")),
    *("tests/cli/commands/simulate/test_plant.py", "tests/plants/test_plant.py"),
    *(
        "tests/assurance/test_plant_simulator.py",
        "tests/grammar/test_format.py",
        "tests/monitor/online/test_online.py",
    ),
)


def install():
    """Make the environment; print its size and the seconds that it took. Exits if it is too large."""
    shutil.rmtree(VENV, ignore_errors=True)
    environment.run([sys.executable, "-m", "venv", str(VENV)])
    pip = [str(PYTHON), "-m", "pip", "install", "--quiet", "--disable-pip-version-check"]
    begin = time.monotonic()
    environment.run([*pip, "-c", "constraints.txt", "."])
    seconds = time.monotonic() - begin
    size = sum(path.lstat().st_size for path in VENV.rglob("*") if not path.is_dir()) / 1e6
    print(f"the base installation: {size:.0f} MB with pip, {seconds:.0f} s", flush=True)
    if size > LARGEST:
        sys.exit(f"that is more than {LARGEST} MB")
    environment.run([*pip, "-c", "constraints.txt", *TOOLS])


def check(tests, path=""):
    """Run tests in the environment, with another folder on the path of every Python. Exits on failure."""
    options = ["-q", "-n", "2", "--dist", "loadfile", "-p", "no:cacheprovider", "-k", "not memory"]
    command = [str(PYTHON), "-m", "pytest", *options, *tests]
    variables = {**os.environ, "PYTHONPATH": path}
    if code := subprocess.call(command, cwd=str(environment.ROOT), env=variables):
        sys.exit(code)


if __name__ == "__main__":
    install()
    check(WITHOUT_TORCH)
    check(PORTABLE, str(environment.ROOT / "tests/portable"))
