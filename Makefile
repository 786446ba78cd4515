# `make` prints the targets. Everything runs in .venv, which holds what was needed so far: the package
# itself (train, resume), its tools (test, lint, …), the site's (docs, notebooks).
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed
DEV_STAMP := $(VENV)/.installed-dev
DOCS_STAMP := $(VENV)/.installed-docs
SITE := docs/_build/html
# In the folder build/wheel, which holds nothing of the checkout.
WHEEL := bin/sacformer
TINY := --total-env-steps 1024 --prefill-env-steps 512 --chunk-env-steps 256 --eval-every 512 \
	--eval-episodes 1 --buffer-capacity 20000 --num-envs 2 --batch-size 8 --updates-per-env-step 0.25 \
	--actor-width 16 --actor-layers 1 --actor-heads 1 --critic-width 32
RUN ?= runs/halfcheetah
FLAGS ?=
JSON ?=

.DEFAULT_GOAL := help
.PHONY: help install train resume bench test test-all lint types docs notebooks linkcheck wheel check clean

help:  ## what each target does
	@grep -E '^[a-z-]+:.*##' $(MAKEFILE_LIST) | sed -E 's/:[^#]*## /\t/' | expand -t 12

install: $(DEV_STAMP)  ## make .venv with the package and its tools (skipped when current)

$(STAMP): pyproject.toml sacformer_jax/version.py
	@echo "installing into $(VENV) …"; start=$$(date +%s); \
	$(PYTHON) -c 'import sys; sys.exit("Python 3.11 or newer is needed: make PYTHON=python3.11") if sys.version_info < (3, 11) else None' && \
	$(PYTHON) -m venv $(VENV) && \
	$(BIN)/python -m pip install --quiet --editable '.[video]' && \
	touch $@ && \
	echo "installation took $$(($$(date +%s) - start)) s"

$(DEV_STAMP): $(STAMP)
	@echo "installing the tools …"; start=$$(date +%s); \
	$(BIN)/python -m pip install --quiet --editable '.[dev]' && \
	touch $@ && \
	echo "installation took $$(($$(date +%s) - start)) s"

$(DOCS_STAMP): $(DEV_STAMP)
	$(BIN)/python -m pip install --quiet --editable '.[docs]' && touch $@

train: $(STAMP)  ## train SACFormer on HalfCheetah (15 minutes on 2 cores), then evaluate it in Gymnasium
	$(BIN)/sacformer train --preset cpu --env HalfCheetah --run-dir $(RUN) $(FLAGS)
	$(BIN)/sacformer evaluate $(RUN) --gymnasium --episodes 10

resume: $(STAMP)  ## continue `make train` where it stopped
	$(BIN)/sacformer resume $(RUN)
	$(BIN)/sacformer evaluate $(RUN) --gymnasium --episodes 10

bench: install  ## how fast it is: a table, with JSON=FILE that file, too, with FLAGS="--part env" one part
	$(BIN)/python experiments/benchmark.py $(if $(JSON),--json $(JSON)) $(FLAGS)

test: install  ## the quick tests (under 12 minutes on 2 cores)
	$(BIN)/python -m pytest -n 2 --dist loadscope --no-loadscope-reorder -m "not slow" $(FLAGS)

test-all: install  ## every test, the slow ones too
	$(BIN)/python -m pytest $(FLAGS)

lint: install  ## ruff: errors, style, formatting
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

types: install  ## mypy
	$(BIN)/mypy

docs: $(DOCS_STAMP)  ## the documentation as a site in docs/_build/html; a warning or broken link is an error
	$(BIN)/python -m sphinx -W --keep-going -j auto -q docs $(SITE)
	cd docs && $(abspath $(BIN))/python -m site_tools.built_links _build/html
	@echo "open $(SITE)/index.html"

notebooks: $(DOCS_STAMP)  ## run the notebooks (a minute each)
	cd docs && $(abspath $(BIN))/python -m site_tools.notebooks

linkcheck: $(DOCS_STAMP)  ## look whether external links still lead somewhere (needs a network)
	$(BIN)/python -m sphinx -b linkcheck -q docs docs/_build/linkcheck

wheel: install  ## build sdist and wheel, install the wheel in an empty environment, and train with it
	rm -rf dist build/wheel
	$(BIN)/python -m build --outdir dist .
	$(PYTHON) -m venv build/wheel
	build/wheel/bin/python -m pip install --quiet dist/*.whl
	cd build/wheel && $(WHEEL) --version
	cd build/wheel && $(WHEEL) describe --preset paper --env Humanoid
	cd build/wheel && $(WHEEL) train --env Hopper --run-dir run $(TINY)
	cd build/wheel && $(WHEEL) evaluate run --gymnasium --episodes 2
	rm -rf build/wheel

check: test lint types docs notebooks wheel  ## what CI runs

clean:  ## remove .venv and caches (runs/ stays)
	rm -rf $(VENV) .pytest_cache .mypy_cache .ruff_cache build dist docs/_build *.egg-info
