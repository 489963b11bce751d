# `make` lists the targets. Every target does its own set-up: scripts/setup_venv makes .venv once and then stays quiet.
SHELL := /bin/bash
MAKEFLAGS += --no-print-directory
.DEFAULT_GOAL := help
# A recipe is a command a line, without loops: SIGTERM to make ends the command then, and not only a shell around it.

BIN := .venv/bin
# Extra arguments, as in `make demo ARGS=--help` or `make test PYTEST_ARGS="-k slip"`.
ARGS ?=
PYTEST_ARGS ?=

# What runs here talks to nothing outside this machine and logs below the checkout, unless the user says otherwise.
export ROS_AUTOMATIC_DISCOVERY_RANGE ?= LOCALHOST
export ROS_LOG_DIR ?= $(CURDIR)/log/ros

##@ The two commands
.PHONY: demo test
demo: setup-run  ## Drive the New York City Cycle over DDS, record it, show the result (2 min; the first time also set-up, 1 to 5 min)
	@$(BIN)/demo $(ARGS)

test: lint type  ## Linters, types and all tests (20 min)
	@$(BIN)/python -m pytest -n auto --maxprocesses 4 --dist loadfile -m "not nightly and not processes" $(PYTEST_ARGS)
	@$(BIN)/python -m pytest -m "processes and not nightly" $(PYTEST_ARGS)

##@ Results
.PHONY: policies study unseen docs-numbers roads bench bench-peers
CYCLES := $(foreach cycle,ftp75 hwfet nycc,--cycle config/cycles/$(cycle).csv)
SOLVE := $(BIN)/solve_policy --vehicle config/vehicles/jalalmaab_2015.yaml $(CYCLES) --friction 0.9 0.5 0.2 \
  --grid coupled --output policies
policies: setup-run  ## Solve the shipped policies again, the same tables come out (2 min)
	@$(SOLVE) --idle-drive drag $(ARGS)
	@$(SOLVE) --idle-drive none $(ARGS)

study: setup-run  ## All tables and figures of the paper, and what beats them (3 min)
	@$(BIN)/evaluate --study runs/study $(ARGS)

unseen: setup-run  ## Our strategy on cycles and cars that were not there when it was made (half an hour)
	@$(BIN)/evaluate --unseen runs/unseen $(ARGS)

roads: setup-run  ## Drive the scenarios of real roads: what comes out, beside what is required (2 min)
	@$(BIN)/python -m campaigns.roads --unknown --page docs/roads.md $(ARGS)

docs-numbers: setup-run  ## Fill the numbers of README and docs: stored results and commands (5 min; ARGS=--study: seconds)
	@$(BIN)/python scripts/docs_numbers $(ARGS)

define BENCHMARK
@echo "== $(1)"
@$(BIN)/python benchmarks/$(1).py

endef
bench: bench-peers  ## All that has to be fast, each beside its peer, in one table, then control path and signals (an hour)
	@mkdir -p runs
	@$(BIN)/python benchmarks/performance.py --fastsim runs/peers/bin/python --json runs/performance.json $(ARGS)
	$(foreach name,control_path convergence learning plant signals,$(call BENCHMARK,$(name)))

bench-peers: setup-dev  ## FASTSim in an environment of its own, runs/peers: a peer of benchmarks/performance.py (1 min)
	@test -x runs/peers/bin/python || $(BIN)/python -m venv runs/peers
	@runs/peers/bin/python -m pip install --quiet --require-hashes -r benchmarks/requirements.txt -c benchmarks/requirements.txt

##@ Documentation
.PHONY: docs
docs: setup-dev  ## The pages, every --help and the API as a site: build/docs/html/index.html (2 min; the first time also set-up, 1 to 5 min)
	@$(BIN)/python scripts/docs_site $(ARGS)

##@ Safety
.PHONY: faults soak nightly coverage mutation
faults: setup-run  ## Fault campaign over DDS with the simulator in the loop (7 min)
	@$(BIN)/python -m campaigns.faults $(ARGS)

soak: setup-dev  ## In real time at 100 Hz: memory, deadlines, counts (30 min)
	@$(BIN)/python -m campaigns.soak $(ARGS)

nightly: setup-dev  ## The tests that are too long for every run, and far more random cases in the others (hours)
	@HYPOTHESIS_PROFILE=nightly $(BIN)/python -m pytest -m "nightly or not nightly" --timeout 7200 $(PYTEST_ARGS)

# Compiled kernels leave no trace, so the safety code is covered as plain Python.
SAFETY := iwm_power_manager/model/gate.py,iwm_power_manager/model/limits.py,iwm_power_manager/model/torque.py,iwm_power_manager/control/*
coverage: setup-dev  ## Line and branch coverage of control law, limits, gating and input checks: 100 % (15 min)
	@$(BIN)/coverage erase
	@NUMBA_DISABLE_JIT=1 $(BIN)/coverage run -m pytest test/model test/control $(PYTEST_ARGS)
	@$(BIN)/coverage combine --quiet
	@$(BIN)/coverage report --include='$(SAFETY)' --fail-under=100

mutation: setup-dev  ## Mutate the same modules: do the tests notice? (hours; ARGS=--swaps, front for rear: half an hour)
	@$(BIN)/python scripts/mutation $(ARGS)

##@ Parts
.PHONY: setup lint type format sbom build clean setup-run setup-dev help
setup: setup-dev  ## Only set up: .venv with everything that demo, tests, docs and watch_car need (1 to 5 min)

lint: setup-dev  ## ruff: style, docstrings, likely mistakes; import-linter: the layers (1 min)
	@$(BIN)/ruff check .
	@$(BIN)/lint-imports --no-logo 2> /dev/null || $(BIN)/lint-imports

type: setup-dev  ## mypy, strict (1 min)
	@$(BIN)/mypy

format: setup-dev  ## Reformat the sources (seconds)
	@$(BIN)/ruff check --fix . && $(BIN)/ruff format .

sbom: setup-dev  ## What a user's installation is made of, as a CycloneDX list: sbom.cdx.json (seconds)
	@cat requirements/{build,base,ros}.txt | $(BIN)/cyclonedx-py requirements - --output-reproducible --of JSON -o sbom.cdx.json
	@echo "sbom.cdx.json: $$(grep -c '"purl"' sbom.cdx.json) components"

build: setup-dev  ## colcon build into build/ and install/ (1 min)
	@scripts/colcon_build

clean:  ## Remove what was built, logged or cached here; .venv stays (seconds)
	@rm -rf build install log dist .pytest_cache .hypothesis .mypy_cache .ruff_cache .coverage .coverage.* htmlcov *.egg-info sbom.cdx.json
	@find . -name __pycache__ -not -path './.venv/*' -prune -exec rm -rf {} +

setup-run:
	@scripts/setup_venv run

setup-dev:
	@scripts/setup_venv dev

help:
	@awk 'BEGIN {FS = ":.*## "} /^##@/ {printf "\n%s\n", substr($$0, 5)} \
	  /^[a-z-]+:.*## / {printf "  make %-12s %s\n", $$1, $$2}' Makefile
