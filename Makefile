# Every target sets up what it needs in .venv; nothing else on the machine is touched.
PYTHON ?= python3
PYTEST_ARGS ?=
VENV := .venv
BIN := $(VENV)/bin
PIP := $(BIN)/python -m pip --disable-pip-version-check
SETUP_FILES := pyproject.toml constraints.txt
DEMO_OUT := runs/demo

.DEFAULT_GOAL := help
.PHONY: help setup demo test check format bench clean distclean

help:  ## show this list
	@grep -hE '^[a-z]+:.*## ' $(MAKEFILE_LIST) | awk -F ':.*## ' '{printf "  make %-10s %s\n", $$1, $$2}'

$(BIN)/python:
	@command -v "$(PYTHON)" >/dev/null 2>&1 || { \
	  echo "mjhab: no '$(PYTHON)' found. Install Python 3.11 or newer, or name one: make PYTHON=python3.12 ..." >&2; exit 1; }
	@"$(PYTHON)" -c 'import sys; sys.exit(sys.version_info < (3, 11))' || { \
	  echo "mjhab needs Python >= 3.11, but '$(PYTHON)' is $$("$(PYTHON)" --version 2>&1). Name a newer one: make PYTHON=python3.12 ..." >&2; exit 1; }
	@"$(PYTHON)" -m venv $(VENV) || { rm -rf $(VENV); \
	  echo "mjhab: could not make a virtual environment (on Debian/Ubuntu: apt install python3-venv)." >&2; exit 1; }

$(VENV)/.core: $(SETUP_FILES) | $(BIN)/python
	@echo "mjhab: installing into $(VENV), once"
	@$(PIP) install -q -c constraints.txt -e .
	@touch $@

$(VENV)/.dev: $(SETUP_FILES) | $(BIN)/python
	@echo "mjhab: installing with development tools into $(VENV), once"
	@$(PIP) install -q -c constraints.txt -e '.[dev]'
	@touch $(VENV)/.core $@

setup: $(VENV)/.dev  ## install mjhab and its development tools into .venv

demo: $(VENV)/.core  ## a Fetch robot does SetTable in furnished homes; films and report in runs/demo
	$(BIN)/mjhab eval --task set_table --policy expert --episodes 4 --worlds 4 --seed 0 --films 4 --out $(DEMO_OUT) --overwrite
	@echo "Open in a browser (no network needed): $(CURDIR)/$(DEMO_OUT)/report.html"

test: $(VENV)/.dev  ## the whole test suite, with the slowest tests listed at the end
	$(BIN)/python -m pytest --durations=15 --durations-min=0.5 $(PYTEST_ARGS)

check: $(VENV)/.dev  ## lint, format, types and the import rule
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/pyright
	$(BIN)/python -m pytest -q tests/test_imports.py

format: $(VENV)/.dev  ## rewrite the sources in the house format
	$(BIN)/ruff format .
	$(BIN)/ruff check --fix .

bench: $(VENV)/.core  ## control steps per second of the engine and of the environment
	$(BIN)/mjhab bench sim --worlds 16

clean:  ## remove caches and build products (runs and .venv stay)
	rm -rf build dist .pytest_cache .ruff_cache .hypothesis
	find src tests -name __pycache__ -type d -prune -exec rm -rf {} +

distclean: clean  ## also remove .venv
	rm -rf $(VENV) src/*.egg-info
