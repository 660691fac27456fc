# Needs Python >= 3.11 with venv, git and make. Everything else goes into .venv, in this checkout.

PYTHON ?= python3
ARGS ?=
JOBS ?= 2
VENV := .venv
BIN := $(VENV)/bin
INSTALL := $(BIN)/python -m pip install --quiet --no-input --disable-pip-version-check --no-deps

# One file is unpacked by one core, the largest first.
INSTALL_FILES = printf '%s\n' $(filter %.txt,$^) | xargs -P $(JOBS) -I {} $(INSTALL) --require-hashes -r {}

# What the demo and every command in the README need.
DEMO := $(patsubst %,requirements/%.txt,geometry core view figures build control recording exchange)
TEST := $(patsubst %,requirements/%.txt,peers test learning usd check notebooks)

# Where there are wheels of ROS 2, and what tf2_msgs is compiled with; elsewhere tests of real nodes are skipped.
WHEELS := $(shell $(PYTHON) -c 'import platform as p; print(p.system(), p.machine(), *p.python_version_tuple()[:2])')
ROS := $(if $(and $(filter Linux-x86_64-3-11,$(subst $() ,-,$(WHEELS))),$(shell command -v cmake),$(shell command -v c++)),$(VENV)/ros.installed)

.PHONY: help demo test docs ros sanitize fuzz faults release format clean
.NOTPARALLEL:

help:
	@echo "make demo    a robot opens and closes a kitchen, live in the browser (ARGS=--headless: a table, a picture, and end)"
	@echo "make test    formatter, linter, types, layers, tests"
	@echo "make docs    the documentation as pages that need no network: build/site/index.html"
	@echo "make ros     an environment with ROS 2, .venv/ros, for kineverse ros without an installation of it"
	@echo "make sanitize  all C with sanitizers, and the tests that use it (ARGS=--short: a little of each)"
	@echo "make fuzz    look for inputs that break a reader (ARGS='--target sdf --minutes 60')"
	@echo "make faults  damage files of model servers, cut networks, kill and freeze processes (ARGS=live: of a moving robot)"
	@echo "make release  build the distributions, check them, and try them in clean environments (ARGS='--only core')"
	@echo "make format  format the code and mend what the linter can mend"
	@echo "make clean   remove the environment and what the tools left"

demo: $(VENV)/demo.installed
	$(BIN)/kineverse live $(ARGS)

test: $(VENV)/test.installed $(ROS)
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/mypy --num-workers $(JOBS)
	$(BIN)/lint-imports --no-logo
	@# Tests start commands by the dozen: each would compile the package anew where Python is told to keep nothing.
	$(BIN)/python -m compileall -q -j $(JOBS) src studies ros tests
	@# To have the values in a failed assertion printed takes each worker 13 s: only what fails is run with it, again.
	@# The tests of a file share what takes long to make, so that they stay in one process.
	$(BIN)/python -m pytest -q -n $(JOBS) --dist loadfile --no-loadscope-reorder --assert=plain $(ARGS) || \
	    { $(BIN)/python -m pytest -q --last-failed --last-failed-no-failures=none $(ARGS); exit 1; }

docs: $(VENV)/docs.installed
	$(BIN)/python tools/website --jobs $(JOBS) $(ARGS)

ros: $(VENV)/ros.installed

sanitize: $(VENV)/test.installed
	$(BIN)/python tools/sanitize.py $(ARGS)

fuzz: $(VENV)/fuzz.installed
	PYTHONPATH=tools $(BIN)/python -m fuzz $(ARGS)

faults: $(VENV)/test.installed
	PYTHONPATH=tools $(BIN)/python -m faults $(ARGS)

release: $(VENV)/release.installed
	$(VENV)/release/bin/python tools/release $(ARGS)

format: $(VENV)/test.installed
	$(BIN)/ruff format .
	$(BIN)/ruff check --fix .

clean:
	rm -rf $(VENV) .import_linter_cache .mypy_cache .pytest_cache .ruff_cache .hypothesis build dist

$(BIN)/python:
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || { \
	    echo "Kineverse needs Python 3.11 or newer, and $(PYTHON) is not: make PYTHON=/path/to/python"; exit 1; }
	$(PYTHON) -m venv $(VENV)

# The package, its studies and its ROS nodes go in last and as they lie here, so that an edit needs no second installation.
$(VENV)/demo.installed: $(DEMO) pyproject.toml studies/pyproject.toml ros/kineverse_ros/setup.py | $(BIN)/python
	@echo "Installing into $(VENV); this takes a minute, once."
	@$(INSTALL_FILES)
	$(INSTALL) --no-build-isolation --editable . --editable studies --editable ros/kineverse_ros
	@touch $@

$(VENV)/test.installed: $(TEST) $(VENV)/demo.installed | $(BIN)/python
	@echo "Installing what the tests need into $(VENV); this takes a minute, once."
	@$(INSTALL_FILES)
	@touch $@

# The wheels start each Python of their environment twice, so they have one of their own, with .venv behind it.
$(VENV)/ros.installed: requirements/ros.txt tools/ros_environment.py $(VENV)/demo.installed | $(BIN)/python
	@echo "Installing ROS 2 into $(VENV)/ros; this takes a minute, once."
	@$(BIN)/python -m venv --without-pip --clear $(VENV)/ros
	@$(BIN)/python -m pip --python $(VENV)/ros/bin/python install --quiet --no-input --disable-pip-version-check \
	    --no-deps --require-hashes -r requirements/ros.txt
	@$(VENV)/ros/bin/python tools/ros_environment.py $(BIN)/python
	@touch $@

# It has other versions of what .venv has.
$(VENV)/release.installed: requirements/release.txt | $(BIN)/python
	@$(BIN)/python -m venv --clear $(VENV)/release
	@$(BIN)/python -m pip --python $(VENV)/release/bin/python install --quiet --no-input --disable-pip-version-check \
	    --no-deps --require-hashes -r requirements/release.txt
	@touch $@

# Sphinx imports what it documents, the parts for other libraries as well.
$(VENV)/docs.installed: requirements/docs.txt $(VENV)/test.installed
	@$(INSTALL_FILES)
	@touch $@

$(VENV)/fuzz.installed: requirements/fuzz.txt $(VENV)/test.installed
	@$(INSTALL_FILES)
	@touch $@
