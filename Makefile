# make demo   learn, compare, draw: a few minutes       make speed     speed measurements
# make test   the core test suite                       make test-all  also tests/extras, nothing skipped
# make lint   format, lint, types, import contracts
# make leaderboard   all planners on all suites

PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
# One thread per process: small batches gain nothing from more.
export OMP_NUM_THREADS ?= 1

.PHONY: demo programs test test-all lint speed leaderboard clean
# one after the other: they share an environment, and the programs come before what is built by them
.NOTPARALLEL:

demo: $(VENV)/installed
	$(BIN)/python recipes/demo.py

test: $(VENV)/installed-dev
	$(BIN)/python -m pytest -n 2 tests --ignore=tests/extras

test-all: programs test $(VENV)/installed-extras
	$(BIN)/python -m pytest -n 2 tests/extras

programs:
	tests/extras/install.sh

lint: $(VENV)/installed-dev
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/mypy
	$(BIN)/lint-imports

speed: $(VENV)/installed-dev
	$(BIN)/python -m benchmarks.frontier
	$(BIN)/python -m benchmarks.environment
	$(BIN)/python -m benchmarks.training
	$(BIN)/python -m benchmarks.curves
	$(BIN)/python -m benchmarks.memory

leaderboard: $(VENV)/installed
	$(BIN)/python recipes/leaderboard.py

$(BIN)/python:
	$(PYTHON) -m venv $(VENV)

# torch first and by its exact version, so that no later step chooses another build
$(VENV)/installed: pyproject.toml constraints.txt marl_explore/native/frontier.c | $(BIN)/python
	$(BIN)/python -m pip install -q "torch==$$(sed -n 's/^torch==//p' constraints.txt)"
	$(BIN)/python -m pip install -q -c constraints.txt -e .
	touch $@

$(VENV)/installed-dev: $(VENV)/installed
	$(BIN)/python -m pip install -q -c constraints.txt -e ".[dev]"
	touch $@

$(VENV)/installed-extras: $(VENV)/installed-dev
	$(BIN)/python -m pip install -q -c constraints.txt -e ".[dev,browser,ray,tensorboard,wandb,mlflow]"
	touch $@

clean:
	rm -rf $(VENV) demo leaderboard build dist *.egg-info
