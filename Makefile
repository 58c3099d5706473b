# make train   learn Swimmer        make test   every fast check        make help   the rest
#
# Each target sets up .venv by itself, once: nothing needs to be installed by hand but Python and make.

.DEFAULT_GOAL := help
.DELETE_ON_ERROR:
.PHONY: help setup baselines ray trackers train test test-slow docs package lock clean

PYTHON ?=
RUN_DIR ?=
UV ?= uv
# To the commands through their environment: it may have spaces in it.
export RUN_DIR

VENV := .venv
BIN := $(VENV)/bin
READY := $(VENV)/.ready
DOCS := $(VENV)/.docs
CANDIDATES := $(if $(PYTHON),$(PYTHON),python3.13 python3.12 python3.11 python3)
FITS := import sys, ensurepip, venv; sys.exit(sys.version_info < (3, 11))

help:  ## this list
	@sed -n 's/^\([a-z-]*\):.*  ## \(.*\)$$/  make \1|\2/p' $(firstword $(MAKEFILE_LIST)) | while IFS='|' read -r name text; do printf '%-18s %s\n' "$$name" "$$text"; done
	@echo
	@echo '  PYTHON=python3.12 chooses the interpreter that .venv is made with, RUN_DIR=runs/mine where `make train` writes.'

train: $(READY)  ## learn Swimmer with the fast preset: a gait within 10 minutes on 2 cores
	$(BIN)/metrpo train Swimmer $(if $(RUN_DIR),--run-dir "$$RUN_DIR")

test: $(READY)  ## lint, types, import rules and the fast tests
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports --no-logo
	$(BIN)/pytest -n 2 --dist worksteal

test-slow: $(READY)  ## the tests that learn for minutes
	$(BIN)/pytest -m slow --timeout=1800

docs: $(DOCS)  ## build the documentation in site/; a broken link or anchor stops it
	$(BIN)/python docs/prepare.py
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict

package: $(READY)  ## build wheel and sdist, and try them where nothing else is installed
	.ci/package $(BIN)/python

setup: $(READY)  ## only set up .venv

# PyTorch by itself first, so that one that is installed already is kept. Not in the lock file: nothing else needs it.
baselines: $(READY)  ## add what the systems ppo and ddpg need (PyTorch, Stable-Baselines3)
	$(BIN)/python -m pip install --disable-pip-version-check torch==2.13.0
	$(BIN)/python -m pip install --disable-pip-version-check 'stable-baselines3>=2.7'

ray: $(READY)  ## add what `--backend ray` needs, and the slow test of it
	$(BIN)/python -m pip install --disable-pip-version-check 'ray>=2.49'

trackers: $(READY)  ## add what `--track` needs, and the tests of it
	$(BIN)/python -m pip install --disable-pip-version-check -e '.[wandb,mlflow,trackio]'

lock:  ## take the newest versions into the two lock files (needs uv; no other target does)
	$(UV) pip compile --quiet --upgrade --universal --python-version 3.11 --fork-strategy requires-python \
	  --extra dev --extra video --annotation-style line --custom-compile-command 'make lock' \
	  --no-emit-index-url --no-emit-find-links pyproject.toml --output-file requirements.lock
	$(UV) pip compile --quiet --upgrade --universal --python-version 3.11 --fork-strategy requires-python \
	  --group docs --constraints requirements.lock --annotation-style line --custom-compile-command 'make lock' \
	  --no-emit-index-url --no-emit-find-links --output-file requirements-docs.lock

clean:  ## remove .venv, the built documentation and the tools' caches; runs stay
	rm -rf $(VENV) site build/docs .pytest_cache .mypy_cache .ruff_cache .import_linter_cache .hypothesis

# Made again when the lock file or pyproject.toml is newer. An interrupted set-up leaves no stamp, so it is taken up again.
$(READY): pyproject.toml requirements.lock
	@if $(BIN)/python -c '$(FITS)' >/dev/null 2>&1 && $(BIN)/python -m pip --version >/dev/null 2>&1; then exit 0; fi; \
	for candidate in $(CANDIDATES); do \
	  if $$candidate -c '$(FITS)' >/dev/null 2>&1; then \
	    echo "Setting up $(VENV) with $$candidate ($$($$candidate -V)), once; this takes a few minutes."; \
	    exec $$candidate -m venv --clear $(VENV); \
	  fi; \
	done; \
	echo 'make: expected Python >= 3.11 with its venv module, found none among: $(CANDIDATES)' >&2; \
	echo '      Install it (Debian, Ubuntu: apt install python3 python3-venv) or name one: make PYTHON=/path/to/python3.12 ...' >&2; \
	exit 1
	$(BIN)/python -m pip install --disable-pip-version-check -r requirements.lock
	$(BIN)/python -m pip install --disable-pip-version-check --no-deps -e .
	@touch $@

$(DOCS): requirements-docs.lock $(READY)
	$(BIN)/python -m pip install --disable-pip-version-check -r requirements-docs.lock
	@touch $@
