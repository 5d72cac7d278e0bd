# Needs make and Python 3.10 to 3.13 with pip, nothing else: what DAGmap uses is installed, in the
# versions and with the hashes that requirements/*.txt name, into .venv-demo or .venv beside this file.
#
#   make demo         replay the office with three robots; results in out/office
#   make fleet        the same as three processes that talk over the network; see examples/fleet
#   make test         make check, then the test suite
#   make check        ruff, mypy, import-linter
#   make bench        measure the speed (dagmap bench)
#   make figures      the paper's figures and what was measured beside them, in out/figures; minutes
#   make sweep        thousands of simulated missions with faults and liars, SEEDS=2000 for more, and
#                     a real robot killed 200 times, KILLS=2000 for more
#   make reliability  all figures and plots of docs/reliability.md; hours; PARTS="sweep loss" for some
#   make fuzz         fuzz all that reads foreign bytes, 10^6 executions (RUNS=...); Linux, Python 3.11 on
#   make docs         build the site into out/site
#   make lock         renew requirements/*.txt after a change of dependencies in pyproject.toml
#   make clean-cache  forget compiled kernels
#   make clean        remove all that the above have made
#
# Another interpreter: make PYTHON=python3.12 demo

PYTHON ?= python3
DEMO := .venv-demo
TEST := .venv
LOCK := .venv-lock
# -qq: errors only. The package is built by the locked hatchling, not by one fetched on the side.
PIP := -m pip --disable-pip-version-check --no-input -qq install
LOCAL := --no-deps --no-build-isolation --force-reinstall
COMPILE := $(LOCK)/bin/uv pip compile --quiet --upgrade --universal --python-version 3.10 \
  --generate-hashes --no-emit-index-url --no-emit-find-links --no-annotate \
  --custom-compile-command 'make lock' pyproject.toml requirements/build.in
# Tests that compare kernels with their slow twins; they must also pass as plain Python.
TWINS := tests/test_graph.py tests/test_fold.py tests/test_codec.py tests/test_frames.py
# The long scenarios are runs of their own; a sweep takes the short ones, with so many seeds each.
SWEPT = $(filter-out scenarios/hour.toml scenarios/hundred.toml,$(wildcard scenarios/*.toml))
SEEDS ?= 500
KILLS ?= 200
OFFICE := examples/office/robot1 examples/office/robot2 examples/office/robot3

# A sourced ROS workspace sets PYTHONPATH; its packages must not mix with those of the environments.
unexport PYTHONPATH

.PHONY: demo fleet test check bench figures sweep reliability fuzz docs lock clean clean-cache
.DELETE_ON_ERROR:

demo: $(DEMO)/.package
	@$(DEMO)/bin/dagmap replay $(OFFICE) --out out/office --force

fleet: $(DEMO)/.package
	@examples/fleet/run $(DEMO)/bin/dagmap

test: check
	NUMBA_DISABLE_JIT=1 $(TEST)/bin/python -m pytest -q -n 2 $(TWINS)
	$(TEST)/bin/python -m pytest -n 2 --dist worksteal

check: $(TEST)/.package
	$(TEST)/bin/ruff check .
	$(TEST)/bin/ruff format --check .
	@if $(TEST)/bin/python -c 'import sys; sys.exit(sys.version_info < (3, 11))'; then \
	  echo $(TEST)/bin/mypy; $(TEST)/bin/mypy; \
	else echo "mypy is left out: the last numpy for Python 3.10 has types that later ones corrected"; fi
	$(TEST)/bin/lint-imports --no-logo

bench: $(TEST)/.package
	@$(TEST)/bin/dagmap bench

figures: $(TEST)/.package
	@$(TEST)/bin/python experiments/all.py --out out/figures

sweep: $(TEST)/.package
	@$(TEST)/bin/dagmap simulate $(SWEPT) --seeds $(SEEDS)
	DAGMAP_KILLS=$(KILLS) $(TEST)/bin/python -m pytest -q tests/test_fleet_crash.py::TestKill

reliability: $(TEST)/.package
	@$(TEST)/bin/python bench/reliability.py $(PARTS)

RUNS ?= 1000000
fuzz: $(TEST)/.fuzz
	$(TEST)/bin/python fuzz/run.py all --runs $(RUNS)

docs: $(TEST)/.docs
	NO_MKDOCS_2_WARNING=1 $(TEST)/bin/python -m mkdocs build --strict --quiet

# The demo installs a copy as a user would; the tests see the sources themselves.
$(DEMO)/.package: $(DEMO)/.requirements pyproject.toml $(shell find src/dagmap -name '*.py')
	@$(DEMO)/bin/python $(PIP) $(LOCAL) .
	@touch $@

$(TEST)/.package: $(TEST)/.requirements pyproject.toml
	@$(TEST)/bin/python $(PIP) $(LOCAL) --editable .
	@touch $@

$(DEMO)/.requirements: requirements/demo.txt | $(DEMO)/bin/python
	@echo "Installing what DAGmap needs into $(DEMO); the first time this takes a minute or two."
	@$(DEMO)/bin/python $(PIP) --require-hashes -r $<
	@touch $@

$(TEST)/.requirements: requirements/test.txt | $(TEST)/bin/python
	@echo "Installing what the tests need into $(TEST); the first time this takes a minute or two."
	@$(TEST)/bin/python $(PIP) --require-hashes -r $<
	@touch $@

$(TEST)/.fuzz: requirements/fuzz.txt $(TEST)/.package
	@$(TEST)/bin/python $(PIP) --require-hashes -r $<
	@touch $@

$(TEST)/.docs: requirements/docs.txt $(TEST)/.package
	@$(TEST)/bin/python $(PIP) --require-hashes -r $<
	@touch $@

# Debian and Ubuntu may have pip but not ensurepip: then the pip outside puts one into the environment.
$(DEMO)/bin/python $(TEST)/bin/python $(LOCK)/bin/python:
	@$(PYTHON) -c 'import sys; sys.exit(not (3, 10) <= sys.version_info[:2] < (3, 14))' || { \
	  echo "Python 3.10 to 3.13 is wanted, $(PYTHON) is not one of them." \
	    "Name one: make PYTHON=python3.12 $(MAKECMDGOALS)" >&2; exit 1; }
	@if $(PYTHON) -c 'import ensurepip' 2>/dev/null; then $(PYTHON) -m venv --clear $(@D)/..; \
	else $(PYTHON) -m venv --clear --without-pip $(@D)/.. && \
	  $(PYTHON) -m pip --python $@ -qq install pip; fi

lock: $(LOCK)/bin/uv
	$(COMPILE) --extra fleet --extra rgbd --extra report --extra view --extra ros \
	  --output-file requirements/demo.txt
	$(COMPILE) --extra dev --constraint requirements/demo.txt --output-file requirements/test.txt
	$(COMPILE) --extra fuzz --constraint requirements/test.txt --output-file requirements/fuzz.txt
	$(COMPILE) --extra docs --constraint requirements/test.txt --output-file requirements/docs.txt
	@! grep -n '://' requirements/*.txt || { echo "An address in a lock file, see above" >&2; exit 1; }

$(LOCK)/bin/uv: | $(LOCK)/bin/python
	@$(LOCK)/bin/python $(PIP) uv

# numba notices a change in a kernel's own file, not in one that it calls from another file.
clean-cache:
	find src bench experiments fuzz tests $(wildcard $(DEMO)) \( -name '*.nbi' -o -name '*.nbc' \) -delete

clean: clean-cache
	rm -rf $(DEMO) $(TEST) $(LOCK) out build dist .hypothesis .import_linter_cache .mypy_cache \
	  .pytest_cache .ruff_cache .benchmarks
	find src bench experiments fuzz tests -name __pycache__ -prune -exec rm -rf {} +
