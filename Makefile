# A bare machine needs make and Python 3.11 or newer: every target first sets up what it uses.
# Another Python: make test PYTHON=python3.12 VENV=.venv312

PYTHON ?= python3
VENV ?= .venv
WORKS ?= gomes2016 goeller2015 metaxas1993
COLCON_VENV := .venv-colcon

# On matrices this small a second thread makes BLAS slower.
export OPENBLAS_NUM_THREADS := 1
export OMP_NUM_THREADS := 1

PIP := -m pip install -qq --disable-pip-version-check
READY := $(VENV)/.ready
COLCON_READY := $(COLCON_VENV)/.ready

.PHONY: help demo test lint bench reproduce clean

help:  ## List the targets
	@sed -n 's/^\([a-z]*\):.*## /  make \1\t/p' $(MAKEFILE_LIST)

demo: $(READY)  ## Predict and project a moving towel; results in out/demo
	$(VENV)/bin/cloth-predict demo

test: $(READY) $(COLCON_READY)  ## Run the tests; ARGS go to pytest
	$(VENV)/bin/python -m pytest -n 2 --dist loadfile $(ARGS)

lint: $(READY)  ## Check style, formatting and types
	$(VENV)/bin/python -m ruff check
	$(VENV)/bin/python -m ruff format --check
	$(VENV)/bin/python -m mypy cloth_predict

bench: $(READY)  ## Run every benchmark
	@set -e; for file in benchmarks/bench_*.py; do echo "== $$file"; $(VENV)/bin/python $$file; done

reproduce: $(READY)  ## Repeat the experiments of all works, quickly; results in out/WORK
	@set -e; for work in $(WORKS); do echo "== $$work"; \
	  $(VENV)/bin/cloth-predict reproduce $$work --quick -o out/$$work $(ARGS); done

clean:  ## Remove all that the other targets made, the environments too
	rm -rf .venv .venv312 $(COLCON_VENV) build install log out *.egg-info
	rm -rf .hypothesis .mypy_cache .pytest_cache .ruff_cache
	find . -name __pycache__ -prune -exec rm -r {} +

# True where rclpy comes with the system (a sourced Jazzy), not from another virtual environment.
SYSTEM_ROS := import rclpy, sensor_msgs, sys; \
	sys.exit(sys.prefix != sys.base_prefix and rclpy.__file__.startswith(sys.prefix))

$(READY): setup.py setup.cfg pyproject.toml
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null || { \
	  echo "error: Python 3.11 or newer is needed, PYTHON=$(PYTHON) is:" \
	    "$$($(PYTHON) --version 2>&1 | head -n 1)" >&2; exit 1; }
	@$(PYTHON) -c 'import ensurepip, venv' 2>/dev/null || { \
	  echo "error: $(PYTHON) has no venv module (Debian and Ubuntu: apt install python3-venv)" >&2; \
	  exit 1; }
	@if $(PYTHON) -c '$(SYSTEM_ROS)' 2>/dev/null; \
	then extras=test,lint; system=--system-site-packages; \
	else extras=test,lint,ros; system=; fi; \
	echo "Setting up $(VENV) ($$($(PYTHON) --version), $$extras); the first time takes a minute"; \
	$(PYTHON) -m venv $$system $(VENV) && $(VENV)/bin/python $(PIP) -e ".[$$extras]"
	@touch $@

# The extra by name: colcon needs nothing else of the package.
COLCON_EXTRA := from importlib.metadata import requires; \
	print(*(r.split(";")[0] for r in requires("cloth_predict") if "colcon" in r.split(";")[-1]))

# colcon apart from the rest, whose setuptools it would hold back; not where there is one already.
$(COLCON_READY): setup.py | $(READY)
	@if ! command -v colcon >/dev/null; then \
	  echo "Setting up $(COLCON_VENV) to test the colcon build"; \
	  $(PYTHON) -m venv $(COLCON_VENV) && $(COLCON_VENV)/bin/python $(PIP) \
	    $$($(VENV)/bin/python -c '$(COLCON_EXTRA)') && touch $@; \
	fi
