# `make demo` and `make test` need nothing but Python 3.11 or newer: each sets up .venv by itself, once.
# The set-up is repeated only after pyproject.toml or constraints.txt has changed.
# Settings: PYTHON=python3.12 chooses the interpreter, JOBS=4 the number of test processes.

VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.set-up
JOBS ?= $(shell n=$$(getconf _NPROCESSORS_ONLN 2>/dev/null || echo 2); [ $$n -gt 8 ] && echo 8 || echo $$n)

.DEFAULT_GOAL := help
.DELETE_ON_ERROR:
.PHONY: help setup demo test format bench constraints clean

help:  ## list the commands
	@sed -n 's/^\([a-z]*\):.*## \(.*\)/make \1|\2/p' $(MAKEFILE_LIST) | awk -F'|' '{printf "%-18s%s\n", $$1, $$2}'

setup: $(STAMP)  ## make .venv with the tested versions of everything

demo: $(STAMP)  ## generate faces, train, score, write one report to ./derender-demo (minutes, offline)
	@$(BIN)/derender demo $(ARGS)

test: $(STAMP)  ## every test, ruff and pyright; ARGS="-k render" narrows it down
	@OMP_NUM_THREADS=1 MKL_NUM_THREADS=1 NUMBA_NUM_THREADS=2 $(BIN)/python -m pytest -n $(JOBS) --dist worksteal $(ARGS)

format: $(STAMP)  ## ruff: formatting and the fixes it is sure of
	@$(BIN)/ruff format . && $(BIN)/ruff check --fix .

bench: $(STAMP)  ## the speed tables of docs/performance.md
	@$(BIN)/python benchmarks/rasterize.py
	@$(BIN)/python benchmarks/training_step.py $(ARGS)

constraints: $(STAMP)  ## write the versions installed in .venv to constraints.txt
	@{ sed -n '/^#/p' constraints.txt; \
	   $(BIN)/python -m pip freeze --all --exclude-editable | sed -e 's/+[a-z0-9.]*$$//' -e '/ @ /d'; } > constraints.tmp
	@mv constraints.tmp constraints.txt && touch $(STAMP)

clean:  ## remove .venv and everything a tool has cached
	@rm -rf $(VENV) .pytest_cache .ruff_cache .hypothesis build dist
	@find . -name __pycache__ -type d -prune -exec rm -rf {} +

$(STAMP): pyproject.toml constraints.txt
	@set -e; \
	for python in $(PYTHON) python3.11 python3.12 python3.13 python3 python; do \
		$$python -c 'import sys, venv, ensurepip; sys.exit(sys.version_info < (3, 11))' 2>/dev/null && found=$$python && break; \
	done; \
	if [ -z "$$found" ]; then \
		echo "derender needs Python 3.11 or newer with its venv module; none was found (name one: make PYTHON=/path/to/python3)" >&2; exit 2; \
	fi; \
	echo "Setting up $(VENV) with $$($$found --version) (once; a few minutes, mostly PyTorch)"; \
	$$found -m venv $(VENV); \
	{ $(BIN)/python -m pip install --upgrade -c constraints.txt pip && \
	  $(BIN)/python -m pip install -c constraints.txt -e . --group dev; } > $(VENV)/set-up.log 2>&1 \
	|| { tail -n 25 $(VENV)/set-up.log >&2; echo "Set-up failed; the whole log is in $(VENV)/set-up.log" >&2; exit 1; }
	@touch $@
