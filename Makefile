# symgraph's commands; `make` alone lists them. Each sets up .venv when pyproject.toml has changed.

# What the tests need of pyproject.toml's extras.
EXTRAS := all

BIN := .venv/bin
SETUP := .venv/.set-up

# The first Python that runs, is new enough and can make environments; name another with `make PYTHON=...`.
USABLE := import sys, venv, ensurepip; sys.exit(sys.version_info < (3, 11))
PYTHON ?= $(shell for python in python3 python3.11 python3.12 python3.13 python3.14; do \
	$$python -c '$(USABLE)' 2>/dev/null && echo $$python && break; done)

# One thread per process: the matrices are small, and processes share the cores already.
export OPENBLAS_NUM_THREADS := 1
export OMP_NUM_THREADS := 1
export MKL_NUM_THREADS := 1

.DEFAULT_GOAL := help
.PHONY: help test format pour docs bench

help:  ## list the commands
	@sed -nE 's/^([a-z]+):.*## (.*)/make \1\t\2/p' Makefile | expand -t 14

test: $(SETUP)  ## check style, types and behaviour
	$(BIN)/ruff check
	$(BIN)/ruff format --check
	$(BIN)/mypy
	$(BIN)/pytest

format: $(SETUP)  ## lay the code out as `make test` wants it
	$(BIN)/ruff check --fix
	$(BIN)/ruff format

pour: $(SETUP)  ## learn to pour; options: make pour ARGS="--material vsc"
	PYTHONPATH=. $(BIN)/python docs/examples/pour.py $(ARGS)

docs: $(SETUP)-docs  ## build the site, running every example, in docs/_build/html
	$(BIN)/sphinx-build -W --keep-going -b html docs docs/_build/html

bench: $(SETUP)-bench  ## measure speed
	$(BIN)/pytest tests/benchmarks

$(SETUP): pyproject.toml constraints.txt Makefile
	@test -n "$(PYTHON)" || { echo "No Python 3.11 or newer with venv on this machine. Debian: apt-get install" \
		"python3 python3-venv; otherwise name one: make $(MAKECMDGOALS) PYTHON=/path/to/python3.11" >&2; exit 1; }
	@"$(PYTHON)" -c '$(USABLE)' || { echo "PYTHON=$(PYTHON) is not a Python 3.11 or newer with venv" >&2; exit 1; }
	"$(PYTHON)" -m venv .venv
	$(BIN)/pip install -qq --disable-pip-version-check -c constraints.txt -e ".[$(EXTRAS)]"
	@touch $@

$(SETUP)-%: $(SETUP)
	$(BIN)/pip install -qq --disable-pip-version-check -c constraints.txt -e ".[$*]"
	@touch $@
