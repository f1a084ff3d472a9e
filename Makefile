# make demo   learn, compare, draw: a few minutes       make speed     speed measurements
# make test   the core test suite                       make test-all  also tests/extras, nothing skipped
# make lint   format, lint, types, import contracts
# make docs   the documentation site, in docs/_build/html
# make dist   an sdist and a wheel with the kernels, in dist/
# make leaderboard   all planners on all suites for any robots

PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
# One thread per process: small batches gain nothing from more.
export OMP_NUM_THREADS ?= 1

# BenchMARL needs an environment of its own: it asks for other versions than it runs on
BENCHMARL := .venv-benchmarl
# and so does ROS: its wheels start Python anew to find their libraries
ROS := .venv-ros
# and RLlib, which pins another version of gymnasium; the site is built there, too
RLLIB := .venv-rllib
# and the newest versions that pyproject.toml allows
NEWEST := .venv-newest

.PHONY: demo dist docs docs-links environments programs test test-newest test-all test-benchmarl test-docs test-extras test-rllib test-ros lint speed leaderboard clean
# one after the other: they share an environment, and the programs come before what is built by them
.NOTPARALLEL:

demo: $(VENV)/installed
	$(BIN)/python recipes/demo.py

test: $(VENV)/installed-dev
	$(BIN)/python -m pytest -n 2 tests --ignore=tests/extras

test-all: programs test test-benchmarl test-docs test-rllib test-ros test-extras

test-extras: $(VENV)/installed-extras
	$(BIN)/python -m pytest -n 2 tests/extras \
	  --ignore=tests/extras/benchmarl --ignore=tests/extras/docs --ignore=tests/extras/rllib \
	  --ignore=tests/extras/ros2

test-benchmarl: $(BENCHMARL)/installed
	$(BENCHMARL)/bin/python -m pytest tests/extras/benchmarl

test-docs: docs
	$(RLLIB)/bin/python -m pytest tests/extras/docs

test-rllib: $(RLLIB)/installed
	$(RLLIB)/bin/python -m pytest tests/extras/rllib

# what will break next, not what is broken: .ci/run shows it and goes on
test-newest:
	$(PYTHON) -m venv --clear $(NEWEST)
	$(NEWEST)/bin/python -m pip install -q --upgrade --upgrade-strategy eager . pytest hypothesis
	$(NEWEST)/bin/python -m pip list | grep -E "^(torch|torchrl|tensordict|numpy|gymnasium) "
	cp -r tests pyproject.toml $(NEWEST)  # away from the source, which has no kernels
	cd $(NEWEST) && bin/python -m pytest -q tests/happo tests/transforms

test-ros: $(ROS)/installed
	$(ROS)/bin/python -m pytest tests/extras/ros2

programs:
	tests/extras/install.sh

# all that the tests need, one after the other: each builds the package in the same folder
environments: $(VENV)/installed-extras $(BENCHMARL)/installed $(RLLIB)/installed $(ROS)/installed

lint: $(VENV)/installed-dev
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/mypy
	$(BIN)/lint-imports

# Everything anew; a warning is an error. NOTEBOOKS=cache keeps what tutorials showed last time.
NOTEBOOKS ?= force
docs: $(RLLIB)/installed
	rm -rf docs/_build/html
	$(RLLIB)/bin/python -m sphinx -E -W --keep-going -n -q -j 2 -D nb_execution_mode=$(NOTEBOOKS) \
	  -d docs/_build/doctrees -b html docs docs/_build/html

# asks every other site that the pages link to
docs-links: $(RLLIB)/installed
	$(RLLIB)/bin/python -m sphinx -q -D nb_execution_mode=off \
	  -d docs/_build/doctrees-links -b linkcheck docs docs/_build/links

speed: $(VENV)/installed-dev
	$(BIN)/python -m benchmarks.frontier
	$(BIN)/python -m benchmarks.environment
	$(BIN)/python -m benchmarks.training
	$(BIN)/python -m benchmarks.curves
	$(BIN)/python -m benchmarks.worlds
	$(BIN)/python -m benchmarks.memory

# the wheel fits Linux systems of the last ten years; it is built from the sdist
dist: $(VENV)/installed-dev
	rm -rf dist
	$(BIN)/python -m build -q --outdir dist/plain
	PATH="$(abspath $(BIN)):$$PATH" $(BIN)/python -m auditwheel repair --wheel-dir dist dist/plain/*.whl
	mv dist/plain/*.tar.gz dist
	rm -r dist/plain

leaderboard: $(VENV)/installed
	$(BIN)/python recipes/leaderboard.py

$(BIN)/python:
	$(PYTHON) -m venv $(VENV)

# torch first and by its exact version, so that no later step chooses another build
$(VENV)/installed: pyproject.toml constraints.txt $(wildcard marl_explore/core/native/*.[ch]) | $(BIN)/python
	$(BIN)/python -m pip install -q "torch==$$(sed -n 's/^torch==//p' constraints.txt)"
	$(BIN)/python -m pip install -q -c constraints.txt -e .
	touch $@

$(VENV)/installed-dev: $(VENV)/installed
	$(BIN)/python -m pip install -q -c constraints.txt -e ".[dev]"
	touch $@

$(VENV)/installed-extras: $(VENV)/installed-dev
	$(BIN)/python -m pip install -q -c constraints.txt -e ".[dev,browser,export,lab,mpe,pursuit,ray,ros,sb3,tensorboard,wandb,mlflow]"
	touch $@

$(BENCHMARL)/installed: pyproject.toml constraints.txt
	$(PYTHON) -m venv $(BENCHMARL)
	$(BENCHMARL)/bin/python -m pip install -q "torch==$$(sed -n 's/^torch==//p' constraints.txt)"
	$(BENCHMARL)/bin/python -m pip install -q -c constraints.txt -e ".[lab]" pytest
	$(BENCHMARL)/bin/python -m pip install -q --no-deps "benchmarl==1.5.2"
	$(BENCHMARL)/bin/python -m pip install -q "hydra-core==1.3.8"
	touch $@

$(RLLIB)/installed: pyproject.toml constraints.txt
	$(PYTHON) -m venv $(RLLIB)
	$(RLLIB)/bin/python -m pip install -q "torch==$$(sed -n 's/^torch==//p' constraints.txt)"
	sed '/^gymnasium==/d' constraints.txt > $(RLLIB)/constraints.txt
	$(RLLIB)/bin/python -m pip install -q -c $(RLLIB)/constraints.txt -e ".[rllib,docs]" pytest
	touch $@

$(ROS)/installed: pyproject.toml constraints.txt
	$(PYTHON) -m venv $(ROS)
	$(ROS)/bin/python -m pip install -q "torch==$$(sed -n 's/^torch==//p' constraints.txt)"
	$(ROS)/bin/python -m pip install -q -c constraints.txt -e ".[lab]" pytest hypothesis \
	  colcon-common-extensions "ros-jazzy-rclpy[fastrtps]" ros-jazzy-rosgraph-msgs ros-jazzy-std-msgs \
	  ros-jazzy-geometry-msgs ros-jazzy-nav-msgs ros-jazzy-sensor-msgs ros-jazzy-diagnostic-msgs \
	  ros-jazzy-visualization-msgs
	touch $@

clean:
	rm -rf $(VENV) $(NEWEST) $(BENCHMARL) $(RLLIB) $(ROS) demo docs/_build leaderboard build dist *.egg-info
