# The two commands: `make demo` and `make test`. Each sets up its own .venv first; nothing is needed from root.

PYTHON ?= $(firstword $(foreach p,python3 python3.13 python3.12 python3.11 python3.10,$(shell \
	$(p) -c 'import sys; sys.exit(sys.version_info < (3, 10))' 2>/dev/null && echo $(p))))
VENV := .venv
BIN := $(VENV)/$(if $(filter Windows_NT,$(OS)),Scripts,bin)
READY := $(VENV)/.ready
# The package as it is installed, with integrations inside: mypy does not know setuptools' package-dir.
TYPES := $(VENV)/types
DEMO_OUT ?= demo_out
SCANS ?= 24
# Two test processes of one thread each; `make test PARALLEL=` runs them in one.
PARALLEL ?= -n 2 --dist loadfile

.PHONY: demo test test-slow test-lowest lint types lock docs notebooks bench clean

demo: $(READY)  ## scans mixed with synthetic ones, a recorded scan changed, a page to look at
	$(BIN)/python tools/demo.py $(DEMO_OUT) --scans $(SCANS)

test: $(READY)  ## every test that is not marked slow
	OMP_NUM_THREADS=1 $(BIN)/python -m pytest $(PARALLEL) -m "not slow"

test-slow: $(READY)  ## the tests that are marked slow
	OMP_NUM_THREADS=1 $(BIN)/python -m pytest $(PARALLEL) -m slow

test-lowest: $(READY)  ## tests of files and banks on the lowest versions of the dependencies; installs them
	$(BIN)/python tools/test_lowest_versions.py

lint: types  ## style and types
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

types: $(READY)  ## types alone
	rm -rf $(TYPES) && mkdir -p $(TYPES)/lidar_synth
	ln -s $(CURDIR)/lidar_synth/* $(CURDIR)/integrations $(TYPES)/lidar_synth
	cd $(TYPES) && $(CURDIR)/$(BIN)/mypy --config-file $(CURDIR)/pyproject.toml --cache-dir $(CURDIR)/.mypy_cache

docs: $(READY)  ## the site, in site/; a broken link fails
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict

notebooks: $(READY)  ## runs the notebooks of docs/notebooks and keeps their outputs, which the site shows
	$(BIN)/python tools/docs/notebooks.py

bench: $(READY)  ## every table of tools/bench
	for script in tools/bench/*.py; do case $$script in */timing.py) ;; *) $(BIN)/python $$script || exit 1;; esac; done

# Versions of constraints.txt for Linux, macOS and Windows, Python 3.11.5 and later: mkdocs-material asks for that.
lock: $(READY)  ## requirements-dev.txt, the development versions with hashes; needs a network connection
	$(BIN)/python -m pip install --quiet --disable-pip-version-check uv==0.13.9
	$(BIN)/uv pip compile pyproject.toml --extra dev --constraint constraints.txt --universal --python-version 3.11.5 \
		--generate-hashes --no-annotate --no-emit-index-url --custom-compile-command "make lock" --quiet \
		--output-file requirements-dev.txt

clean:
	rm -rf $(VENV) $(VENV)-lowest $(DEMO_OUT) site build dist *.egg-info

# Python 3.10 has no wheels of some pinned versions: there the newest that fit are taken.
PINS = $(shell $(PYTHON) -c 'import sys; print("--constraint constraints.txt" * (sys.version_info >= (3, 11)))')

# torch is asked for by itself first, so that its version is settled before anything else can pull another.
$(READY): pyproject.toml constraints.txt
	@test -n "$(PYTHON)" || { echo "Python 3.10 or later is needed: apt-get install python3 python3-venv, or make PYTHON=/path/to/python3.10"; exit 1; }
	@$(PYTHON) -c 'import ensurepip, venv' 2>/dev/null || { echo "$(PYTHON) has no venv: apt-get install python3-venv"; exit 1; }
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check $(PINS) torch
	$(BIN)/python -m pip install --quiet --disable-pip-version-check $(PINS) --editable '.[dev]'
	@touch $@
