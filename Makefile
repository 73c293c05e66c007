# `make repro` makes the results, `make test` checks everything. Both set themselves up with Python 3.11
# (the published results'), 3.12 or 3.13, git and make.
#
#   PYTHON=...           the Python to use, where `python3.11` is not on the path
#   PIP_TORCH_ARGS=...   options for the installation of torch alone, such as the index that has its CPU build
#   JOBS=N               tests at once: one more than there are processors if not given, at most 8
#   KILLS=60 SEED=0      of `make soak`

SHELL := bash
.SHELLFLAGS := -euo pipefail -c
.DELETE_ON_ERROR:
.DEFAULT_GOAL := help

PIP_TORCH_ARGS ?=
# Tests wait for processes that they start, so there is one more than processors; each may have a Ray of its own.
CORES := $(shell getconf _NPROCESSORS_ONLN || echo 2)
JOBS ?= $(shell echo $$(( $(CORES) < 8 ? $(CORES) + 1 : 8 )))
KILLS ?= 60
SEED ?= 0
FITS := -c 'import sys; sys.exit(not (3, 11) <= sys.version_info[:2] <= (3, 13))'
PYTHON ?= $(shell for p in python3.11 python3.12 python3.13 python3; do $$p $(FITS) 2>/dev/null && echo $$p && break; done)
READY := .venv/.ready
# A file of tests goes to one process, which makes its fixtures once; `tests/conftest.py` has the order.
SHARED := --dist loadfile --no-loadscope-reorder

# The environment's own programs first: `rhmc` in a DVC stage is this project's.
export PATH := $(CURDIR)/.venv/bin:$(PATH)
export DVC_SITE_CACHE_DIR := $(CURDIR)/.dvc/tmp/site
export PIP_DISABLE_PIP_VERSION_CHECK := 1
export PIP_NO_INPUT := 1
unexport PYTHONPATH
# Each of the processes that tests and studies start would compile the project again.
unexport PYTHONDONTWRITEBYTECODE

.PHONY: help setup repro test deep check bench soak report docs ui lock clean

help: ## What there is to make
	@grep -hE '^[a-z]+:.*## ' Makefile | sed -E 's/^([a-z]+):[^#]*## /  make \1\t/' | expand -t 14

setup: $(READY) ## The environment in .venv, exactly as in requirements.lock

# The page is no out of the pipeline (dvc.yaml says why): it is made where it is missing, or older than what it is of.
# Results that differ from the published ones are said in the last line and are no failure: the run is done.
repro: $(READY) ## Train, track and report on the profile in params.yaml; an interrupted one continues
	@profile=$$(rhmc profile); out="results/$$profile"; \
	  python .ci/dvc_repro.py || { echo "Not finished. What is done is kept: \`make repro\` continues."; exit 1; }; \
	  [[ -e "$$out/index.html" && -z "$$(find "$$out/runs" -newer "$$out/index.html")" ]] || \
	    rhmc report --profile "$$profile"; \
	  echo; \
	  rhmc verdicts --profile "$$profile"; \
	  echo "MLflow UI: run \`make ui\` and open the address that it prints"; \
	  test ! -d "results/published/$$profile" || \
	    rhmc verify --runs "$$out/runs" --profile "$$profile" || test $$? -eq 4

test: check ## Lint, types and every test
	@python -m pytest -n $(JOBS) $(SHARED)

deep: $(READY) ## Every test in every case, with many more random kills and examples: before a release
	@DEEP=1 python -m pytest -n $(JOBS) $(SHARED)

check: $(READY) ## Lint and types only
	@ruff check --quiet .
	@ruff format --quiet --check . || { echo "Run \`ruff format .\`"; exit 1; }
	@mypy --no-error-summary --num-workers auto

bench: $(READY) ## Speed of the environments and of training, as Markdown tables
	@python benchmarks/env_speed.py
	@python benchmarks/train_speed.py

soak: $(READY) ## Kill drivers, workers and servers of studies again and again; prints what was lost (nothing)
	@python -m tests.robustness.soak --kills $(KILLS) --seed $(SEED)

report: $(READY) ## The report again, from the exported runs
	@profile=$$(rhmc profile) && rhmc report --profile "$$profile"

docs: $(READY) ## The documentation as a site in build/site, which needs no network
	@python -m sphinx -q -W --keep-going -c docs -d build/doctrees . build/site
	@echo "Documentation: build/site/README.html"

ui: $(READY) ## The runs in MLflow's web interface
	@rhmc ui

lock: $(READY) ## Write requirements.lock from .venv, after a deliberate change there
	@{ sed '/^[^#]/,$$d' requirements.lock; pip freeze --all --exclude-editable | grep -v '^pip==' \
	  | sed 's/+cpu$$//' | LC_ALL=C sort -f; } > requirements.lock.new
	@mv requirements.lock.new requirements.lock

clean: ## Remove .venv and caches; results stay
	@rm -rf .venv .mypy_cache .pytest_cache .ruff_cache .hypothesis build *.egg-info
	@find rhmc pipelines reports benchmarks tests -name __pycache__ -prune -exec rm -rf {} +
	@echo "Removed .venv and the caches. Kept every result: work/ (runs, checkpoints) and results/ (remove by hand)."

# torch comes first and alone, so that a build with CUDA is seen before its packages are fetched. The lock is complete,
# which `pip check` makes sure of: nothing has to be resolved, and two processes install 40 packages at a time. Nothing is
# compiled here: two thirds of the packages' code is never imported, and Python keeps what it compiles of the rest.
$(READY): requirements.lock pyproject.toml
	@test -n "$(PYTHON)" || { echo "Python 3.11, 3.12 or 3.13 is needed, and none is on the path." \
	  "Give its path: make PYTHON=/path/to/python3.11"; exit 1; }
	@$(PYTHON) $(FITS) || { echo "Python 3.11, 3.12 or 3.13 is needed, and $(PYTHON) is none of them." \
	  "Give the path of one: make PYTHON=/path/to/python3.11"; exit 1; }
	@echo "Setting up .venv: some minutes, 2.3 GB"
	@test -x .venv/bin/python || $(PYTHON) -m venv .venv
	@python -m pip install --quiet --no-compile --no-deps $(PIP_TORCH_ARGS) "$$(grep '^torch==' requirements.lock)"
	@python .ci/cpu_only.py
	@grep '^[^#]' requirements.lock | xargs -P 2 -n 40 python -m pip install --quiet --no-compile --no-deps
	@python -m pip install --quiet --no-deps --no-build-isolation --editable .
	@python .ci/cpu_only.py
	@python -m pip check
	@touch $(READY)
