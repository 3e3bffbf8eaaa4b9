PYTHON ?= python3
BIN := .venv/bin

.PHONY: help demo test format environment clean

help:
	@echo 'make demo    train, simulate, check and report the traffic benchmark, from nothing'
	@echo 'make test    lint, format, types and tests: what has to be green'
	@echo 'make format  lay the code out and fix what can be fixed'
	@echo 'make clean   remove the environment and the caches; runs/ stays'

demo:
	@$(PYTHON) tools/demo.py

test: environment
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/python -m pytest

format: environment
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

environment:
	@$(PYTHON) tools/environment.py

clean:
	rm -rf .venv .pytest_cache .mypy_cache .ruff_cache .hypothesis build dist
