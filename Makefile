# `make demo` and `make test` are all the set-up there is (README); `make quick` after every change.
PYTHON ?= python3
VENV ?= .venv
BIN := $(VENV)/bin
# pip compiles on one core, and what nobody imports too. Not to compile is no way: where Python may write no
# bytecode (PYTHONDONTWRITEBYTECODE), every process would compile what it imports, torch for one, again.
PIP = $(BIN)/pip install --quiet --no-compile -c constraints.txt
COMPILE = $(BIN)/python -W ignore -m compileall -qq -j 0 -x '/tests?/|/sumo/' $(VENV)/lib || true
RUN ?= runs/demo
SCALE ?= 1
WORKERS ?= 2
SAMPLE ?= 20
PROCESSES ?= 2
# A file's tests stay in one process, in the order of the folders: the longest files come first. A core each: no threads.
PYTEST = OMP_NUM_THREADS=1 $(BIN)/python -m pytest -n $(PROCESSES) --dist loadfile --no-loadscope-reorder --durations=40

.PHONY: demo test soak docs quick pytest unit check kernels nets results pages results-small audit image smoke clean

demo: $(VENV)/.installed
	$(BIN)/cosim run merge --demand contested --policy altruist-rule --beside idm --out $(RUN)

test: $(VENV)/.installed-dev
	$(MAKE) --no-print-directory -j 2 check pytest

# What takes too long for `make test`: every measured page in small, a server on Ray, two on one database.
soak: kernels
	$(PYTEST) -m soak

# Kernels first, so that the tests' processes do not compile the same ones at once.
pytest: kernels
	$(PYTEST)

# What a developer wants to know after every change: lint, and the tests that neither train nor need SUMO.
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

# Every table and figure of docs/results/: first what is measured (costs, predictions; better on an idle
# machine), then what claims need driven (research/claims). The same command continues after an interruption.
# SCALE=0.1: a tenth of the episodes. Those in docs/results/episodes/ need not be driven; ANEW=1 drives them all
# the same, `make audit` a few of them. What has no trained weights is left out and named; `python -m research list`
# says what is still to be driven, and its CPU hours.
CLAIMS = --scale $(SCALE) --workers $(WORKERS) $(if $(ANEW),--anew)
results: $(VENV)/.installed-dev
	$(BIN)/python -m benchmarks.measured
	$(BIN)/python -m benchmarks.learning
	$(BIN)/python -m research drive $(CLAIMS)
	$(BIN)/python -m research.figure8 $(CLAIMS)
	$(BIN)/python -m research page $(CLAIMS)

# The pages of the episodes that are there (docs/results/episodes/, runs/research): minutes, nothing is driven.
pages: $(VENV)/.installed-dev
	$(BIN)/python -m research page

# Some of the kept episodes driven anew: are they the same in every figure and the trace hash?
audit: $(VENV)/.installed-dev
	$(BIN)/python -m research audit --sample $(SAMPLE) --workers $(WORKERS)

# The same in small: one scenario, two episodes each on validation seeds, two seconds long. Shows that all works.
SMALL = --seeds 150000:150002 --scenario merge --duration 2 --untrained --workers $(WORKERS) \
    --runs runs/results-small/research --out runs/results-small/pages
results-small: $(VENV)/.installed-dev
	$(BIN)/python -m benchmarks.measured --small --runs runs/results-small/measured --out runs/results-small/pages
	$(BIN)/python -m benchmarks.learning --out runs/results-small/pages
	$(BIN)/python -m research drive $(SMALL)
	$(BIN)/python -m research.figure8 $(SMALL)
	$(BIN)/python -m research page $(SMALL)

# Rebuild every world's net from its plain XML sources.
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

# The container: docker/build.sh says what it needs, with a Docker engine or without (docs/guides/container.md).
image:
	docker/build.sh

# From build to gate verdict; leaves rows, JUnit and reports in runs/smoke.
smoke: image
	docker/smoke.sh runs/smoke

clean:
	rm -rf $(VENV) build *.egg-info .mypy_cache .ruff_cache .pytest_cache
