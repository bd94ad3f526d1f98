# Everything from nothing: `make demo` and `make test` set up what they need.
SHELL := /bin/bash
.SHELLFLAGS := -eu -o pipefail -c
.DEFAULT_GOAL := help

VENV ?= .venv
COLCON_VENV ?= .venv-colcon
LOCK_VENV ?= .venv-lock
# Any Python 3.10 to 3.13; the first of these that runs and is one.
PYTHON ?= $(shell for p in python3.11 python3.12 python3.13 python3.10 python3; do \
	$$p -c 'import sys, venv, ensurepip; sys.exit(not (3, 10) <= sys.version_info[:2] <= (3, 13))' \
	>/dev/null 2>&1 && { echo $$p; break; }; done)
PY := $(VENV)/bin/python
DEMO_BAG ?= bags/demo
DEMO_OUT ?= results/demo
PYTEST_WORKERS ?= 2
# A test that takes so long hangs: its process prints the stack of every thread and ends, also where one holds
# the interpreter's lock; the test fails by name, and the others are run.
HANGS ?= -o faulthandler_timeout=600 -o faulthandler_exit_on_timeout=true
# More arguments of the accuracy benchmark: make accuracy ACCURACY_ARGUMENTS=--resume
ACCURACY_ARGUMENTS ?=
# Of the population: make population POPULATION_ARGUMENTS='--half test --scenes 500 --out FOLDER'
POPULATION_ARGUMENTS ?= --half development --scenes 60 --workers 2 --out build/population
# Of the harness of kills, which goes on where it was: make soak SOAK_ARGUMENTS='--seed 200 --trials 200'
SOAK_ARGUMENTS ?= --trials 200 --circles 200 --same-draw 30 --two-graphs 30 --soak 3600
# How long each kind of input is fuzzed (s): make fuzz FUZZ_SECONDS=3600
FUZZ_SECONDS ?= 60
# And of the speed benchmark: make bench BENCH_ARGUMENTS='--only chain carving'
BENCH_ARGUMENTS ?=
FROM_NPM := mermaid@11.12.0 @fontsource/stix-two-math@5.3.0

# ROS 2 from PyPI needs its prefix named, stays on this machine, and wants a place for its logs.
export AMENT_PREFIX_PATH := $(abspath $(VENV))$(if $(AMENT_PREFIX_PATH),:$(AMENT_PREFIX_PATH))
export ROS_AUTOMATIC_DISCOVERY_RANGE ?= LOCALHOST
export ROS_LOG_DIR ?= $(abspath .ros_log)
unexport PYTHONPATH

SOURCES := $(shell find csas_shadow_ros msg_adapters config launch -type f \
	-not -name '*.pyc' -not -path '*/__pycache__*' 2>/dev/null)
# What you try out in the tree is yours.
LINTED := csas_shadow_ros msg_adapters benchmarks docs examples launch test setup.py
PACKAGING := setup.py setup.cfg pyproject.toml package.xml

.PHONY: help venv install demo docs test lint types unit long soak fuzz accuracy accuracy-short population bench build lock clean

help: ## list the targets
	@grep -hE '^[a-z-]+:.*##' $(MAKEFILE_LIST) | sed -E 's/^([a-z-]+):.*## /  make \1\t/' | expand -t 18

venv: $(VENV)/.created ## make the virtual environment

$(VENV)/.created:
	@test -n "$(PYTHON)" || { echo "no Python 3.10 to 3.13 with venv found: name one, make PYTHON=..." >&2; exit 1; }
	$(PYTHON) -m venv $(VENV)
	touch $@

# The dependencies once (they change with the packaging), the package itself whenever a file of it changed.
$(VENV)/.dependencies: $(VENV)/.created setup.py pyproject.toml
	$(PY) -m pip install --quiet --disable-pip-version-check 'setuptools>=68,<80' wheel
	$(PY) -m pip install --quiet --disable-pip-version-check '.[ros,test]'
	touch $@

$(VENV)/.installed: $(VENV)/.dependencies $(PACKAGING) $(SOURCES)
	rm -rf build/lib build/bdist.* build/ros2_run
	$(PY) -m pip install --quiet --disable-pip-version-check --no-build-isolation --no-deps --force-reinstall .
	touch $@

install: $(VENV)/.installed ## install the package and ROS 2 into it

demo: install ## replay the demonstration bag
	@mkdir -p $(ROS_LOG_DIR)
	$(VENV)/bin/csas-shadow replay $(DEMO_BAG) --out $(DEMO_OUT) --overwrite

$(VENV)/.docs: $(VENV)/.dependencies setup.py
	$(PY) -m pip install --quiet --disable-pip-version-check --no-build-isolation '.[docs]'
	touch $@

# What the site takes from npm: mermaid, which draws graphs, and a font for equations. Without npm the graphs
# stay text, and the browser's own font serves.
build/from_npm/.there:
	mkdir -p $(@D)
	! command -v npm > /dev/null || (cd $(@D) && npm pack --silent $(FROM_NPM) > /dev/null \
		&& tar -xzf mermaid-*.tgz package/dist/mermaid.min.js && mv package/dist/mermaid.min.js mermaid.js \
		&& tar -xzf fontsource-*.tgz package/files && mv package/files/*-latin-400-normal.woff2 math.woff2 \
		&& rm -r package *.tgz)
	touch $@

docs: install $(VENV)/.docs build/from_npm/.there ## the site, into build/site
	NO_MKDOCS_2_WARNING=1 $(PY) -m mkdocs build --quiet

test: install lint types unit ## lint, types and all tests

lint: install ## ruff
	$(VENV)/bin/ruff check $(LINTED)

types: install ## mypy
	$(VENV)/bin/mypy

unit: install ## pytest alone
	@mkdir -p $(ROS_LOG_DIR)
	$(PY) -m pytest $(HANGS) -n $(PYTEST_WORKERS) --dist loadgroup --ignore=test/nodes
	$(PY) -m pytest $(HANGS) -n $(PYTEST_WORKERS) --dist loadgroup test/nodes --ignore=test/nodes/test_processes.py
	$(PY) -m pytest $(HANGS) test/nodes/test_processes.py  # looks at all of the machine's shared memory: alone on it

long: install ## the tests that `make test` leaves out: more of the same
	@mkdir -p $(ROS_LOG_DIR)
	$(PY) -m pytest -m long

soak: install ## kills, stops, full disks: hundreds of trials, and an hour in one graph
	@mkdir -p $(ROS_LOG_DIR)
	$(PY) test/faults/soak.py $(SOAK_ARGUMENTS)

fuzz: install ## bags and messages, guided by coverage: Atheris, a minute each
	$(PY) -m pip install --quiet --disable-pip-version-check 'atheris>=3,<4'
	for each in message mcap db3 yaml; do $(PY) test/faults/fuzz.py $$each --seconds $(FUZZ_SECONDS); done

accuracy-short: install ## a few cases of it against their floors, in a minute
	$(PY) benchmarks/accuracy.py --short

accuracy: install ## the accuracy benchmark: writes docs/accuracy.md
	$(PY) benchmarks/accuracy.py $(ACCURACY_ARGUMENTS)

population: install ## scenes drawn at random, development half: writes build/population/page.md
	$(PY) benchmarks/population.py $(POPULATION_ARGUMENTS)

bench: install ## the speed benchmark: a table of bounds, docs/performance.json and figure
	@mkdir -p $(ROS_LOG_DIR)
	$(PY) -m pip install --quiet --disable-pip-version-check '.[bench]'
	OPENBLAS_NUM_THREADS=1 $(PY) benchmarks/speed.py $(BENCH_ARGUMENTS)

# What the locked files hold beside the package's own needs: what builds it without an index.
LOCK_BUILD := setuptools>=68,<80\nwheel\n
LOCK_EXTRAS := ros xarray archive cluster maps import security
LOCK := $(LOCK_VENV)/bin/uv pip compile setup.py - --quiet --universal --python-version 3.10 --upgrade \
	--generate-hashes --no-annotate --custom-compile-command "make lock"

lock: $(LOCK_VENV)/.installed ## write constraints/locked*.txt anew: newest versions, with hashes
	printf '$(LOCK_BUILD)' | $(LOCK) --output-file constraints/locked.txt
	printf '$(LOCK_BUILD)' | $(LOCK) $(LOCK_EXTRAS:%=--extra %) --output-file constraints/locked-all.txt

$(LOCK_VENV)/.installed:
	@test -n "$(PYTHON)" || { echo "no Python 3.10 to 3.13 with venv found: name one, make PYTHON=..." >&2; exit 1; }
	$(PYTHON) -m venv $(LOCK_VENV)
	$(LOCK_VENV)/bin/pip install --quiet --disable-pip-version-check 'uv>=0.9,<1'
	touch $@

$(COLCON_VENV)/.installed: setup.py
	@test -n "$(PYTHON)" || { echo "no Python 3.10 to 3.13 with venv found: name one, make PYTHON=..." >&2; exit 1; }
	$(PYTHON) -m venv $(COLCON_VENV)
	$(COLCON_VENV)/bin/pip install --quiet --disable-pip-version-check 'colcon-common-extensions>=0.3' 'setuptools>=68,<80'
	touch $@

build: $(COLCON_VENV)/.installed ## colcon build, with colcon from PyPI
	PATH="$(abspath $(COLCON_VENV))/bin:$$PATH" colcon build --packages-select csas_shadow_ros \
		--base-paths . --event-handlers console_direct+

clean: ## remove what the others made
	rm -rf $(VENV) $(COLCON_VENV) $(LOCK_VENV) build install log results dist .ros_log *.egg-info .mypy_cache .ruff_cache .pytest_cache .hypothesis
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
