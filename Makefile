# `make` prints the targets. Everything runs in .venv, which `install` makes and keeps current.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed
DOCS_STAMP := $(VENV)/.installed-docs
SITE := docs/_build/html
RUN ?= runs/halfcheetah
FLAGS ?=
JSON ?=

.DEFAULT_GOAL := help
.PHONY: help install train resume bench test test-all lint types docs notebooks linkcheck wheel check clean

help:  ## what each target does
	@grep -E '^[a-z-]+:.*##' $(MAKEFILE_LIST) | sed -E 's/:[^#]*## /\t/' | expand -t 12

install: $(STAMP)  ## make .venv with the package and its tools (skipped when current)

$(STAMP): pyproject.toml sacformer_jax/version.py
	@echo "installing into $(VENV) …"; start=$$(date +%s); \
	$(PYTHON) -c 'import sys; sys.exit("Python 3.11 or newer is needed: make PYTHON=python3.11") if sys.version_info < (3, 11) else None' && \
	$(PYTHON) -m venv $(VENV) && \
	$(BIN)/python -m pip install --quiet --editable '.[dev]' && \
	touch $@ && \
	echo "installation took $$(($$(date +%s) - start)) s"

$(DOCS_STAMP): $(STAMP)
	$(BIN)/python -m pip install --quiet --editable '.[docs]' && touch $@

train: install  ## train SACFormer on HalfCheetah (15 minutes on 2 cores), then evaluate it in Gymnasium
	$(BIN)/sacformer train --preset cpu --env HalfCheetah --run-dir $(RUN) $(FLAGS)
	$(BIN)/sacformer evaluate $(RUN) --gymnasium --episodes 10

resume: install  ## continue `make train` where it stopped
	$(BIN)/sacformer resume $(RUN)
	$(BIN)/sacformer evaluate $(RUN) --gymnasium --episodes 10

bench: install  ## how fast it is: a table, with JSON=FILE that file, too, with FLAGS="--part env" one part
	$(BIN)/python experiments/benchmark.py $(if $(JSON),--json $(JSON)) $(FLAGS)

test: install  ## the quick tests (under 12 minutes on 2 cores)
	$(BIN)/python -m pytest -n 2 --dist loadscope -m "not slow" $(FLAGS)

test-all: install  ## every test, the slow ones too
	$(BIN)/python -m pytest $(FLAGS)

lint: install  ## ruff: errors, style, formatting
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

types: install  ## mypy
	$(BIN)/mypy

docs: $(DOCS_STAMP)  ## the documentation as a site, docs/_build/html; warnings and broken links are errors
	$(BIN)/python -m sphinx -W --keep-going -j auto -q docs $(SITE)
	cd docs && ../$(BIN)/python -m site_tools.built_links _build/html
	@echo "open $(SITE)/index.html"

clean:  ## remove .venv and caches (runs/ stays)
	rm -rf $(VENV) .pytest_cache .mypy_cache .ruff_cache build dist *.egg-info
