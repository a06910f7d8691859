PYTHON ?= python3
ORACLE_PYTHON ?= python3.12
VENV := .venv
BIN := $(VENV)/bin
READY := $(VENV)/.ready
PARTIAL := $(VENV)/.partial
PARALLEL := -n auto --maxprocesses 4 --dist loadfile

.DEFAULT_GOAL := help
.PHONY: help setup run test test-all test-machines slow-paths test-min test-latest torture oracle mutants coverage check bench first-try reproduce docs docs-links audit dist clean

help:  ## show this list
	@awk -F ':.*## ' '/^[a-z-]+:.*## / { printf "  make %-13s %s\n", $$1, $$2 }' Makefile

setup: $(READY)  ## create .venv and install lfrtorch with its tools (PYTHON=python3.12 to choose)
	@echo "Ready: $(BIN)/python"

run: $(READY)  ## identify the Bouc-Wen benchmark (ARGS="seed=1 ..." is passed on)
	@$(BIN)/python train.py +bench=boucwen $(ARGS)

test: $(READY)  ## fast tests (ARGS="-k name ..." is passed on)
	@$(BIN)/python -m pytest $(PARALLEL) $(ARGS)

test-all: $(READY)  ## all tests, the slow ones too
	@$(BIN)/python -m pytest -m "" $(PARALLEL) $(ARGS)

test-machines: $(READY)  ## tests that compute, as on other processors (ARGS="oldest newest ...")
	@$(BIN)/python tests/machines.py $(ARGS)

slow-paths: $(READY)  ## fast tests without machine code and other quick ways (ARGS="tests/engine ...")
	@kept=$$(mktemp -d) && trap 'rm -rf "$$kept"' EXIT && \
	    LFRTORCH_SLOW_PATHS=1 NUMBA_CACHE_DIR="$$kept" $(BIN)/python -m pytest $(PARALLEL) $(ARGS)

test-min: $(READY)  ## fast tests with the oldest versions of what lfrtorch needs (ARGS="--keep torch")
	@$(BIN)/python tests/versions.py min $(ARGS)

test-latest: $(READY)  ## fast tests with the newest ones (ARGS="--keep torch")
	@$(BIN)/python tests/versions.py latest $(ARGS)

coverage: $(READY)  ## lines and branches of lfrtorch/ that the fast tests reach
	@$(BIN)/python -m pytest $(PARALLEL) --cov=lfrtorch --cov-branch --cov-report=term:skip-covered $(ARGS)

mutants: $(READY)  ## faults put into the package, room by room: does a test notice? (an hour or two)
	@$(BIN)/python -m pip install -qq --disable-pip-version-check -c constraints.txt -e '.[mutants]'
	@$(BIN)/python tests/mutants.py $(ARGS)

torture: $(READY)  ## kills, full disks, damaged files, nonsense: the page docs/measured/torture.md (two hours; ARGS='--only files')
	@PYTHONPATH=tests $(BIN)/python tests/torture.py $(ARGS)

oracle: $(READY)  ## the numerical core beside another implementation, in .oracle (ORACLE_PYTHON=python3.12)
	@[ -x .oracle/bin/python ] || $(ORACLE_PYTHON) -m venv .oracle
	@.oracle/bin/python -m pip install -qq --disable-pip-version-check freq-statespace==0.2.0
	@$(BIN)/python -m pytest -m "" tests/test_foreign_oracle.py $(ARGS)

check: $(READY)  ## format, lint, types, import order
	@$(BIN)/ruff format --check .
	@$(BIN)/ruff check .
	@$(BIN)/basedpyright
	@$(BIN)/lint-imports --no-logo

bench: $(READY)  ## costs against what is required (PEERS=DIR, ARGS=--quick), or beside BASELINE=DIR
	@$(BIN)/python benchmarks/$(if $(BASELINE),baseline.py "$(BASELINE)",engine.py $(if $(PEERS),--peers "$(PEERS)")) $(ARGS)

first-try: $(READY)  ## is the verdict with all sizes auto right on new data? (ARGS="--label NAME --cases planted:0-39")
	@$(BIN)/python benchmarks/first_try.py $(ARGS)

reproduce: $(READY)  ## the public benchmarks at hand -> RESULTS.md (ARGS="silverbox data.root=DIR")
	@$(BIN)/python scripts/reproduce.py $(ARGS)

docs: $(READY)  ## guide, notebooks, reference -> site/; a broken link is an error (ARGS="-D nb_execution_mode=off")
	@$(BIN)/python -m pip install -qq --disable-pip-version-check -c constraints.txt -e '.[docs]'
	@rm -rf docs/api/generated
	@$(BIN)/sphinx-build -qW --keep-going $(ARGS) -d site/doctrees docs site/html
	@echo "Open site/html/index.html"

docs-links: docs  ## links to other sites, too; needs the network
	@$(BIN)/sphinx-build -qW --keep-going -d site/doctrees -b linkcheck docs site/links

audit:  ## known faults of the versions in constraints.txt; asks pypi.org
	@$(PYTHON) -m venv .venv-audit && .venv-audit/bin/python -m pip install -qq --disable-pip-version-check pip-audit
	@.venv-audit/bin/pip-audit -r constraints.txt --no-deps --disable-pip --strict

dist: $(READY)  ## wheel and sdist in dist/, the same bytes whenever they are built from a commit
	@SOURCE_DATE_EPOCH=$$(git log -1 --format=%ct) $(BIN)/python -m build -q --no-isolation
	@sha256sum dist/*

clean:  ## remove caches and builds; .venv and runs stay
	@rm -rf build dist site docs/api/generated *.egg-info .pytest_cache .ruff_cache .hypothesis .import_linter_cache
	@find . \( -path ./$(VENV) -o -path ./runs \) -prune -o -type d -name __pycache__ -prune -exec rm -rf {} +

# The mark .partial says that a set-up did not come to its end: the next one then starts afresh.
$(READY): pyproject.toml constraints.txt
	@if [ -e $(PARTIAL) ]; then rm -rf $(VENV); fi
	@if [ ! -x $(BIN)/python ]; then \
	    $(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || { \
	        echo "lfrtorch needs Python 3.11 or newer, which $(PYTHON) is not." \
	            "Name another one: make setup PYTHON=python3.12" >&2; exit 1; }; \
	fi
	@echo "Setting up $(VENV): a minute or two, once."
	@mkdir -p $(VENV) && touch $(PARTIAL)
	@[ -x $(BIN)/python ] || $(PYTHON) -m venv $(VENV)
	@$(BIN)/python -m pip install -qq --disable-pip-version-check -c constraints.txt -e '.[dev]'
	@rm $(PARTIAL) && touch $@
