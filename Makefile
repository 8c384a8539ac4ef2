# `make demo` and `make test` include the set-up (README). Use `make quick` after every change.
PYTHON ?= python3
VENV ?= .venv
BIN := $(VENV)/bin
# pip would compile on one core, including modules that are never imported. Without any compilation and with
# PYTHONDONTWRITEBYTECODE, every process would compile its imports again (torch among them).
PIP = $(BIN)/pip install --quiet --no-compile -c constraints.txt
COMPILE = $(BIN)/python -W ignore -m compileall -qq -j 0 -x '/tests?/|/sumo/' $(VENV)/lib || true
RUN ?= runs/demo
SCALE ?= 1
WORKERS ?= 2
SAMPLE ?= 30
PROCESSES ?= 2
# The tests of a file stay in one process, in the order of the folders, long files first. One thread per process.
PYTEST = OMP_NUM_THREADS=1 $(BIN)/python -m pytest -n $(PROCESSES) --dist loadfile --no-loadscope-reorder --durations=40 --durations-min=2

.PHONY: demo test soak docs quick pytest unit check kernels nets results pages results-small audit image smoke clean

demo: $(VENV)/.installed
	$(BIN)/cosim run merge --demand contested --policy altruist-rule --beside idm --out $(RUN)

test: $(VENV)/.installed-dev
	$(MAKE) --no-print-directory -j 2 check pytest

# Tests that take too long for `make test`: every measured page in small, a server on Ray, two on one database.
soak: kernels
	$(PYTEST) -m soak

# Kernels first, so that test processes do not compile the same kernels at the same time.
pytest: kernels
	$(PYTEST)

# Checks after every change: lint, and the tests without training or SUMO.
quick: $(VENV)/.installed-dev
	$(MAKE) --no-print-directory -j 2 check unit

unit: kernels
	$(PYTEST) tests/unit

kernels: $(VENV)/.installed-dev
	$(BIN)/cosim run merge --policy vfn-p --duration 1 --json >/dev/null

check: $(VENV)/.installed-dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports

# The documentation as a site, into site/: open site/index.html. A broken link fails.
docs: $(VENV)/.installed-dev
	PYTHONPATH=. $(BIN)/zensical build --strict --clean

# Every table and figure of docs/results/: first the benchmarks (costs, predictions; better on an idle machine),
# then the episodes of claims (research/claims). The same command continues after an interruption. SCALE=0.1: a
# tenth of the episodes. Episodes in docs/results/episodes/ are not driven again, except with ANEW=1; `make audit`
# drives a sample of them. Policies without trained weights are skipped and named. `python -m research list` lists
# missing episodes and their CPU hours.
CLAIMS = --scale $(SCALE) --workers $(WORKERS) $(if $(ANEW),--anew)
results: $(VENV)/.installed-dev
	$(BIN)/python -m benchmarks.measured
	$(BIN)/python -m benchmarks.learning
	$(BIN)/python -m research drive $(CLAIMS)
	$(BIN)/python -m research.figure8 $(CLAIMS)
	$(BIN)/python -m research page $(CLAIMS)

# The pages of the known episodes (docs/results/episodes/, runs/research): takes minutes, without driving.
pages: $(VENV)/.installed-dev
	$(BIN)/python -m research page

# Drives a sample of the kept episodes again, of every kind, and compares every figure and the trace hash.
audit: $(VENV)/.installed-dev
	$(BIN)/python -m research audit --sample $(SAMPLE) --workers $(WORKERS)

# `make results` in small, as a test: one scenario, two episodes of two seconds each on validation seeds.
SMALL = --seeds 150000:150002 --scenario merge --duration 2 --untrained --workers $(WORKERS) \
    --runs runs/results-small/research --out runs/results-small/pages
results-small: $(VENV)/.installed-dev
	$(BIN)/python -m benchmarks.measured --small --runs runs/results-small/measured --out runs/results-small/pages
	$(BIN)/python -m benchmarks.learning --out runs/results-small/pages
	$(BIN)/python -m research drive $(SMALL)
	$(BIN)/python -m research.figure8 $(SMALL)
	$(BIN)/python -m research page $(SMALL)

# Rebuild every scenario's net from its plain XML sources.
nets: $(VENV)/.installed-dev
	$(BIN)/python -m sumo_scenarios.build

$(VENV)/.installed: pyproject.toml constraints.txt
	$(PYTHON) -m venv $(VENV)
	$(PIP) torch
	$(PIP) -e '.[film]'
	$(COMPILE)
	touch $@

$(VENV)/.installed-dev: $(VENV)/.installed
	$(PIP) -e '.[dev]'
	$(COMPILE)
	touch $@

# The container image: see docker/build.sh for requirements, with or without a Docker engine.
image:
	docker/build.sh

# Build and test the image; rows, JUnit and reports are in runs/smoke.
smoke: image
	docker/smoke.sh runs/smoke

clean:
	rm -rf $(VENV) build *.egg-info .mypy_cache .ruff_cache .pytest_cache
