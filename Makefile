# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
#
# Two commands for everybody:
#   make run     a live cloth, grasped through ROS topics, recorded; ends by itself
#   make test    the tests
# Both make the environment when it is missing, and start at once when it is there.
#
# For those who work on it: make docs (the site), check (what CI runs: format, lint, types, tests), test-long, docs-check,
# engine, sanitize, tidy, bits, format, soak, bench, validate, benchmarks, screenshots, colcon, wheel, clean:
# CONTRIBUTING.md.
# Variables: PYTHON (which Python), VENV (where the environment is), CXX (which compiler), ARGS (more arguments), as in
#   make test ARGS="-k walls"
#   make check VENV=.venv-3.12 PYTHON=python3.12
#   make sanitize TESTS="test/physics/test_plan.py -x"

SHELL := /bin/sh
VENV ?= .venv
BIN := $(VENV)/bin
ARGS ?=
TESTS ?= test/camera/test_depth_camera.py test/engine/test_cpp.py test/engine/test_engine_band.py \
    test/engine/test_engine_bad_input.py test/engine/test_engine_corners.py test/engine/test_grid_bends.py \
    test/physics/test_plan.py test/physics/test_plan_python_forces.py test/physics/test_extrapolation_tableau.py \
    test/physics/test_contact_runs.py test/physics/test_self_contact_law.py

CPP = $(shell find cloth_sim_ros/engine test/engine scripts -path '*/doctest' -prune -o \( -name '*.hpp' -o -name '*.cpp' \) -print)

# Each set of packages (extras of setup.py) has a stamp in the environment, written last.
DEMO := $(VENV)/has_demo
DEV := $(VENV)/has_dev
INPUTS := setup.py setup.cfg constraints.txt
# An environment names its folder in every script: one that was moved, or has lost its Python, is made anew.
ifneq ($(shell test -x $(BIN)/python && cat $(VENV)/made_in 2>/dev/null),$(realpath .))
INPUTS += anew
endif

# The environment brings its own ROS 2. A shell that has sourced another one points Python and the linker at that.
unexport PYTHONPATH PYTHONHOME LD_LIBRARY_PATH AMENT_PREFIX_PATH COLCON_PREFIX_PATH CMAKE_PREFIX_PATH ROS_DISTRO
unexport VIRTUAL_ENV _ROS_WHEELS_BOOTSTRAP_COMPLETE FASTRTPS_DEFAULT_PROFILES_FILE FASTDDS_DEFAULT_PROFILES_FILE
unexport ROS_DISCOVERY_SERVER ROS_LOCALHOST_ONLY
unexport ROS_SECURITY_ENABLE ROS_SECURITY_STRATEGY ROS_SECURITY_KEYSTORE ROS_SECURITY_ENCLAVE_OVERRIDE
# Without Python's caches each of the tests' hundreds of processes compiles the package again.
unexport PYTHONDONTWRITEBYTECODE
ifeq ($(ROS_SECURITY_ENABLE),true)
$(warning ROS_SECURITY_ENABLE is not passed on: the Fast DDS of ROS's wheels on PyPI is built without security)
endif
export RMW_IMPLEMENTATION := rmw_fastrtps_cpp
# A demonstration in a lab must not move somebody's robot: it is heard on this machine alone, unless asked otherwise.
export ROS_AUTOMATIC_DISCOVERY_RANGE ?= LOCALHOST

.PHONY: help run docs docs-check engine engines sanitize tidy bits test test-long check format soak bench validate benchmarks
.PHONY: screenshots colcon wheel clean
.DEFAULT_GOAL := help

help:
	@sed -n 's/^# \{0,1\}//; 3,15p' Makefile

run: $(DEMO) engine
	@$(BIN)/python -m cloth_sim_ros.ros.demo $(ARGS)

# Three processes for two cores, one of them for tests that wait for nodes; a file's tests stay together.
# ARGS="-n 0" runs them in one process.
test: $(DEV) engines
	@$(BIN)/python -m pytest -n auto --dist loadfile --no-loadscope-reorder $(ARGS)

# More cases of what `make test` covers: pytest's marker `long`.
test-long: $(DEV) engines
	@$(BIN)/python -m pytest -m long -n auto --dist loadfile --no-loadscope-reorder $(ARGS) || \
	    { test $$? -eq 5 && echo "This machine has no long tests: it runs too few instruction sets."; }

check: $(DEV) engines
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	@$(BIN)/clang-format --dry-run --Werror $(CPP)
	$(BIN)/mypy
	@$(MAKE) --no-print-directory test

# Builds what is not up to date, beside its sources, which is where an environment finds it: `engine` the library that
# this machine loads, `engines` all that it can run, whose bits the tests compare.
engine engines:
	@python=$$(test -x $(BIN)/python && echo $(BIN)/python || scripts/find_python.sh) && \
	    "$$python" scripts/engine.py $(if $(filter engines,$@),--every)

# Tests with the engine under the address and the undefined-behaviour sanitizer.
sanitize: $(DEV)
	@$(BIN)/python scripts/engine.py --sanitize $(TESTS) $(ARGS)

# clang-tidy on each translation unit of the engine, two at a time; .clang-tidy has the checks.
tidy: $(DEV)
	@find cloth_sim_ros/engine -name '*.cpp' | xargs -P 2 -I{} $(BIN)/clang-tidy --quiet {} -- \
	    -std=c++20 -Icloth_sim_ros/engine -march=native

# The same scenes in ways that bits must not depend on: vectors, C library, numpy, compilers.
bits: $(DEV) engines
	@$(BIN)/python scripts/bits.py $(ARGS)

# The site, into build/docs: docs/*.md, the API from docstrings, the parameters' page from the parameters. Every warning
# (a link that leads nowhere, a page that nothing leads to) is an error.
docs: $(DEV) engine
	@$(BIN)/python -m sphinx -b html -n -W --keep-going -q docs build/docs $(ARGS)
	@echo "cloth_sim_ros: the site is build/docs/index.html"

# Every command and code block of the pages, in order, in a clean clone; what it prints is compared with the page.
docs-check: $(DEV)
	@$(BIN)/python scripts/run_docs.py $(ARGS)

format: $(DEV)
	$(BIN)/ruff format .
	$(BIN)/ruff check --fix .
	@$(BIN)/clang-format -i $(CPP)

# A real hour of grasping; CLOTH_SIM_ROS_SOAK_SECONDS sets another length.
soak: export CLOTH_SIM_ROS_SOAK_SECONDS ?= 3600
soak: $(DEV) engines
	@$(BIN)/python -m pytest -m soak --timeout 0 -s $(ARGS)
	@$(BIN)/python -m pytest -m hypothesis --hypothesis-profile random $(ARGS)
	@$(BIN)/python test/soak_session_kills.py --count 500
	@$(BIN)/python test/soak_files.py --count 500
	@$(BIN)/python test/soak_verify.py --sessions 200
	@$(BIN)/python test/soak_accuracy.py --sessions 30
	@$(BIN)/python test/soak_contact.py --steps 1000000
	@$(BIN)/python test/soak_fit.py --count 20
	@$(BIN)/python test/soak_robot.py --motions 10000
	@$(BIN)/python test/soak_sleep.py --seconds 60
	@$(BIN)/python test/soak_studies.py --runs 1000 --kills 50

# Without ARGS the names of the benchmarks (benchmarks/) and of the commands that validate the physics (validation/).
bench: $(DEV) engine
	@$(BIN)/python -m benchmarks $(ARGS)

validate: $(DEV) engine
	@$(BIN)/python -m validation $(ARGS)

# Rows in docs/data, then docs/benchmarks.md and its figures: an hour or two. ARGS names sections, as in make benchmarks
# ARGS="speed feature-cost"; ARGS=--draw measures nothing.
benchmarks: $(DEV) engine
	@$(BIN)/python scripts/benchmarks_page.py $(ARGS)

# The pictures of the README and docs, anew, from real sessions.
screenshots: $(DEV) engine
	@$(BIN)/python scripts/screenshots.py $(ARGS)
	@$(BIN)/python scripts/session_pictures.py

# The layout that `ros2 run` and `ros2 launch` expect, into install/.
colcon: $(DEV)
	@$(BIN)/colcon build --base-paths . $(ARGS)

# The wheel for other machines, into dist/: all libraries of the processor's family, tried where there is no compiler.
wheel:
	@python=$$(scripts/find_python.sh) && "$$python" scripts/wheel.py

clean:
	rm -rf $(VENV) build dist install log *.egg-info .pytest_cache .mypy_cache .ruff_cache .hypothesis
	find . \( -name __pycache__ -o -name _objects \) -type d -prune -exec rm -rf {} +

.PHONY: anew
anew:

$(DEMO): $(INPUTS)
	@python=$$(scripts/find_python.sh) && \
	    "$$python" scripts/environment.py --folder $(VENV) --extras demo --stamp $(DEMO)

# The second set holds the first.
$(DEV): $(INPUTS)
	@python=$$(scripts/find_python.sh) && \
	    "$$python" scripts/environment.py --folder $(VENV) --extras dev --stamp $(DEV) --stamp $(DEMO)
