PYTHON ?= python3
BIN := .venv/bin
# Hundreds of tests start the program: what Python compiles is kept, whatever the shell says.
export PYTHONDONTWRITEBYTECODE :=

.PHONY: help demo test test-apart test-light format docs site environment clean

help:
	@echo 'make demo        train, simulate, check and report the traffic benchmark, from nothing'
	@echo 'make test        lint, format, types and tests: what has to be green'
	@echo 'make test-apart  tests that start programs of their own, of the tables, and longer variants of tests'
	@echo 'make test-light  the base installation, without torch: its size, and its tests'
	@echo 'make docs        write anew what documents take from the code: commands, codes, files'
	@echo 'make site        build the documentation site into docs/_build; warnings are errors'
	@echo 'make format      lay the code out and fix what can be fixed'
	@echo 'make clean       remove the environment and the caches; runs/ stays'

demo:
	@$(PYTHON) tools/demo.py

test: environment
	$(BIN)/ruff check .
	$(BIN)/ruff check --preview --select PLW1514 stlc benchmarks tools # every text has an encoding
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/python -m pytest -q -n 2 --dist worksteal

test-apart: environment
	$(BIN)/python -m pytest -q -n 2 --dist loadfile -m "apart and not slow and not bench"

test-light:
	@$(PYTHON) tools/light.py

format: environment
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

docs: environment
	$(BIN)/python -m pytest -q tests/test_docs.py tests/editor/test_textmate.py --regenerate

site: environment
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[docs]'
	$(BIN)/python -m sphinx -W --keep-going -q -E -b html docs docs/_build

environment:
	@$(PYTHON) tools/environment.py

clean:
	rm -rf .venv .venv-light .pytest_cache .mypy_cache .ruff_cache .hypothesis build dist docs/_build
