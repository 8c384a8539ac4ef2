# `make demo` and `make test` are all the set-up there is (README).
PYTHON ?= python3
VENV ?= .venv
BIN := $(VENV)/bin
RUN ?= runs/demo

.PHONY: demo test check nets image smoke clean

demo: $(VENV)/.installed
	$(BIN)/cosim run merge --demand contested --policy altruist-rule --out $(RUN)

test: $(VENV)/.installed-dev check
	$(BIN)/python -m pytest

check: $(VENV)/.installed-dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports

# Rebuild every world's net from its plain XML sources.
nets: $(VENV)/.installed-dev
	$(BIN)/python -m sumo_scenarios.build

$(VENV)/.installed: pyproject.toml constraints.txt
	$(PYTHON) -m venv $(VENV)
	$(BIN)/pip install --quiet -c constraints.txt torch
	$(BIN)/pip install --quiet -c constraints.txt -e .
	touch $@

$(VENV)/.installed-dev: $(VENV)/.installed
	$(BIN)/pip install --quiet -c constraints.txt -e '.[dev]'
	touch $@

# The container: docker/build.sh says what it needs, with a Docker engine or without (docs/container.md).
image:
	docker/build.sh

# From build to gate verdict; leaves rows, JUnit and reports in runs/smoke.
smoke: image
	docker/smoke.sh runs/smoke

clean:
	rm -rf $(VENV) build *.egg-info .mypy_cache .ruff_cache .pytest_cache
