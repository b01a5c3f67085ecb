# Every target sets up .venv if needed, and is quick if nothing has changed.
#
#   make run     the quickstart on real data: minutes of training, then a table and a video
#   make test    the tests
#   make check   lint, format, types, layers
#   make slow    the tests that take minutes
#   make docs    the documentation site; warnings are errors
#   make clean   remove everything the other targets create (never your runs)
#
# ARGS adds options to the program behind run, test and slow: make test ARGS="-k rotations -x".

VENV := .venv
BIN := $(VENV)/bin
ARGS :=

# python3.11 first, for machines whose python3 is older.
PYTHON := $(shell command -v python3.11 || command -v python3)
INSTALL := $(BIN)/python -m pip install --quiet --constraint constraints.txt
SOURCES := pyproject.toml constraints.txt

.DEFAULT_GOAL := help
.PHONY: help setup dev run test slow check lint format types layers docs serve clean

help:
	@sed -n '2,/^$$/s/^# \{0,1\}//p' $(firstword $(MAKEFILE_LIST))

# The stamps are written last, so that an interrupted installation is repeated. pip is updated to a
# pinned version too: `pgdm assets fetch` queries it for file locations, which old ones download.
$(VENV)/.pip:
	@test -n "$(PYTHON)" || { echo "No python3 found: install Python 3.11 or newer."; exit 1; }
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' \
		|| { echo "$(PYTHON) is too old: pgdm needs Python 3.11 or newer. Name one with PYTHON=..."; exit 1; }
	@$(PYTHON) -c 'import ensurepip' 2>/dev/null \
		|| { echo "$(PYTHON) cannot make environments: on Debian, apt-get install python3-venv."; exit 1; }
	$(PYTHON) -m venv $(VENV)
	$(INSTALL) --upgrade pip
	@touch $@

$(VENV)/.run: $(SOURCES) | $(VENV)/.pip
	@echo "Installing into $(VENV) (a few minutes, once)"
	$(INSTALL) --editable .
	@touch $@

$(VENV)/.dev: $(SOURCES) | $(VENV)/.pip
	@echo "Installing into $(VENV), development tools included (a few minutes, once)"
	$(INSTALL) --editable '.[dev]'
	@touch $@ $(VENV)/.run

setup: $(VENV)/.run
dev: $(VENV)/.dev

run: setup
	$(BIN)/pgdm-run +experiment=quickstart $(ARGS)

test: dev
	$(BIN)/python -m pytest -n auto --maxprocesses 4 --dist loadfile $(ARGS)

slow: dev
	$(BIN)/python -m pytest -m slow -n auto --maxprocesses 2 --dist loadfile $(ARGS)

check: lint format types layers

lint: dev
	$(BIN)/ruff check .

format: dev
	$(BIN)/ruff format --check .

types: dev
	$(BIN)/pyright --pythonpath $(BIN)/python

layers: dev
	$(BIN)/python -m pytest -q tests/test_layers.py

docs: dev
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict

serve: dev
	$(BIN)/mkdocs serve

clean:
	rm -rf $(VENV) build dist site .pytest_cache .ruff_cache .hypothesis
