# `make demo` trains, evaluates and deploys; `make test` runs the whole test suite, `make quick` the quick part. They install what they need in .venv.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
PIP_INSTALL := $(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt
DEMO := build/demo
WORKERS := -n 3 --no-loadscope-reorder
# Python keeps what it has compiled, also where the environment says otherwise: half the time of collecting the tests.
export PYTHONDONTWRITEBYTECODE :=

.PHONY: demo test quick benchmarks peers lint format docs site clean

demo: $(VENV)/.run
	$(BIN)/bam-train --env bam/pick --algo ppo --out $(DEMO)/pick-ppo.zip --runs $(DEMO)/runs --force
	$(BIN)/bam-eval $(DEMO)/pick-ppo.zip
	$(BIN)/bam-deploy $(DEMO)/pick-ppo.zip

# Tests that fail run once more, one at a time: what fails again fails the run, and what passes is named, to be mended.
test: $(VENV)/.dev peers
	$(BIN)/python -m pytest $(WORKERS) || { [ $$? -eq 1 ] && \
	echo "Once more, one at a time, what failed above. What passes now depends on the load of the machine: mend it." && \
	$(BIN)/python -m pytest --last-failed --last-failed-no-failures none --verbose; }

# Without what needs Ray or ROS 2, trains, or runs whole programs, live agents and tasks.
quick: $(VENV)/.dev
	$(BIN)/python -m pytest $(WORKERS) -m "not (slow or ray or peers or training or whole)"

# Every figure against its goal, on an idle machine in some hours; python -m tests.benchmarks lists them.
benchmarks: $(VENV)/.dev
	$(BIN)/python -m tests.benchmarks all

# ROS 2, a rosbridge server and roslibjs for tests/peers; where they cannot be installed, those tests are skipped.
peers:
	PYTHON=$(PYTHON) tests/peers/install_peers

lint: $(VENV)/.dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

format: $(VENV)/.dev
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

# The generated parts of docs/*.md, from the code.
docs: $(VENV)/.dev
	$(BIN)/python docs/hooks/make_docs.py

# All pages and the reference of the code, with search, in build/site: open build/site/index.html.
site: $(VENV)/.dev
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --quiet

clean:
	rm -rf $(VENV) build dist runs .pytest_cache .mypy_cache .ruff_cache .hypothesis

$(VENV)/.run: pyproject.toml hatch_build.py constraints.txt | $(BIN)/python
	@echo "Installing bam-train with simulation, training and data sets in $(VENV); the first time takes a few minutes."
	$(PIP_INSTALL) -e ".[sim,train,data]"
	@touch $@

$(VENV)/.dev: pyproject.toml hatch_build.py constraints.txt | $(BIN)/python
	@echo "Installing bam-train and the tools of its tests in $(VENV); the first time takes a few minutes."
	$(PIP_INSTALL) -e ".[dev]"
	@touch $@ $(VENV)/.run

$(BIN)/python:
	$(PYTHON) -m venv $(VENV)
