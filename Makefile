# Bare `make` prints this help. Every target sets up what it needs in .venv, with uv where it is installed, else with
# python3 -m venv and pip: what runs is exactly requirements.lock, and tests add requirements-dev.lock to it.

PYTHON ?= python3
BIN := .venv/bin
READY := .venv/.ready
DEV := .venv/.dev

# Linear algebra has one thread in each process, as in `pwatrack` itself: of small matrices more only wait for each other.
export OMP_NUM_THREADS := 1
export OPENBLAS_NUM_THREADS := 1

.PHONY: help
help: ## print this help
	@grep -hE '^[a-z-]+:.*##' $(MAKEFILE_LIST) | sed -E 's/^([a-z-]+):.*## (.*)/  make \1\t\2/' | expand -t 16

# With pip, Python files are compiled when they are first imported: most never are, and compiling all takes nearly as
# much of the processor as all else of the installation. So the example is run once, unseen: that compiles what every
# run imports, and the walk of simulations, both kept on disk, also in containers that forbid Python to write such
# files later.
$(READY): requirements.lock pyproject.toml
	@echo "Setting up .venv (once; about a minute)"
	@if command -v uv >/dev/null 2>&1; then \
	  uv venv -q --clear --python '>=3.11' .venv \
	  && uv pip install -q --python $(BIN)/python --require-hashes -r requirements.lock \
	  && uv pip install -q --python $(BIN)/python --no-deps --no-build-isolation -e . ; \
	else \
	  $(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11) and "Python 3.11 or later is needed, this is " + sys.version + "; try make PYTHON=python3.12")' \
	  && $(PYTHON) -m venv --clear .venv \
	  && $(BIN)/python -m pip install -qq --disable-pip-version-check --no-compile --require-hashes -r requirements.lock \
	  && $(BIN)/python -m pip install -qq --disable-pip-version-check --no-compile --no-deps --no-build-isolation -e . ; \
	fi
	@echo "Compiling (once)"
	@PYTHONDONTWRITEBYTECODE= $(BIN)/python -m compileall -q pwatrack
	@PYTHONDONTWRITEBYTECODE= $(BIN)/pwatrack simulate specs/two_mass_backlash.yaml -q --out .venv/.first >/dev/null && rm -rf .venv/.first
	@touch $@

$(DEV): $(READY) requirements-dev.lock
	@echo "Adding what tests need to .venv (once)"
	@if command -v uv >/dev/null 2>&1; then \
	  uv pip install -q --python $(BIN)/python --require-hashes -r requirements-dev.lock ; \
	else \
	  $(BIN)/python -m pip install -qq --disable-pip-version-check --require-hashes -r requirements-dev.lock ; \
	fi
	@touch $@

.PHONY: setup
setup: $(READY) ## set up .venv with what runs

.PHONY: setup-dev
setup-dev: $(DEV) ## and with what tests need

.PHONY: demo
demo: $(READY) ## design and simulate the paper's example
	@$(BIN)/pwatrack simulate specs/two_mass_backlash.yaml
	@echo "Open the pictures in runs/two_mass_backlash/, for example tracking_error.png"

.PHONY: test
test: $(DEV) ## run the tests, but for those that take long (five minutes on two cores)
	@$(BIN)/pytest -q -n auto $(DIST) -m "not slow"

WORKERS ?= auto
# a file goes to one worker, in the order of tests/conftest.py
DIST := --dist loadfile --no-loadscope-reorder

.PHONY: test-all
test-all: $(DEV) ## run all tests, as CI does
	@$(BIN)/pytest -q -n $(WORKERS) $(DIST)

KINDS ?= 0

.PHONY: test-kernels
test-kernels: $(DEV) ## run the numerical tests under other processors' kernels, in random order (KINDS=1: one of them)
	@$(BIN)/python -m benchmarks.processors --tests $(KINDS)

.PHONY: processors
processors: $(DEV) ## compare the verdicts on 200 pairs of nearly equal modes under all of these (ten minutes)
	@$(BIN)/python -m benchmarks.processors 200

DOCS := .venv/.docs

$(DOCS): $(DEV) docs/requirements.lock
	@if command -v uv >/dev/null 2>&1; then \
	  uv pip install -q --python $(BIN)/python --require-hashes -r docs/requirements.lock ; \
	else \
	  $(BIN)/python -m pip install -qq --disable-pip-version-check --require-hashes -r docs/requirements.lock ; \
	fi
	@touch $@

.PHONY: docs
docs: $(DOCS) ## build the documentation, and run all that it shows (five minutes)
	@$(BIN)/python -m sphinx -b html -a -W --keep-going -n -q -j 2 docs docs/_build/html
	@echo "Open docs/_build/html/index.html"

TRY := dist/.try

.PHONY: dist
dist: $(READY) ## build wheel and sdist, and run the example with each from an empty environment
	@rm -rf dist && $(BIN)/python -m hatchling build -d dist
	@for package in dist/*.whl dist/*.tar.gz; do \
	  echo "Trying $$package" && rm -rf $(TRY) \
	  && if command -v uv >/dev/null 2>&1; then \
	    uv venv -q --python $(BIN)/python $(TRY) && uv pip install -q --python $(TRY)/bin/python "$$package" ; \
	  else \
	    $(BIN)/python -m venv $(TRY) && $(TRY)/bin/python -m pip install -qq --disable-pip-version-check "$$package" ; \
	  fi \
	  && (cd $(TRY) && bin/pwatrack init --from example && bin/pwatrack simulate spec.yaml -q && bin/pwatrack verify runs/spec) \
	  || exit 1; \
	done
	@rm -rf $(TRY) && ls -l dist

PLOTS ?= all

.PHONY: batch
batch: $(READY) ## design and simulate every spec in specs/ (PLOTS=failed: pictures of what does not end as expected)
	@$(BIN)/pwatrack batch specs --jobs 2 --plots $(PLOTS)

PEERS := .venv/.peers

$(PEERS): $(DEV)
	@echo "Installing the peers (once; one that cannot be had is left out)"
	@if command -v uv >/dev/null 2>&1; then INSTALL="uv pip install --python $(BIN)/python"; \
	  else INSTALL="$(BIN)/python -m pip install --disable-pip-version-check"; fi; \
	for peer in $$($(BIN)/python -c 'import tomllib; print(*tomllib.load(open("pyproject.toml", "rb"))["project"]["optional-dependencies"]["bench"])'); do \
	  $$INSTALL -q "$$peer" || true; \
	done
	@touch $@

.PHONY: bench
bench: $(PEERS) ## time our simulation against integrators for general systems
	@$(BIN)/python benchmarks/simulation.py

.PHONY: set-point-bench
set-point-bench: $(PEERS) ## what is made of set-points against Ruckig: when it arrives, and what a sample takes
	@$(BIN)/python benchmarks/set_points.py

.PHONY: lmi-bench
lmi-bench: $(PEERS) ## time our solver of matrix inequalities against CVXPY, PICOS and Clarabel
	@$(BIN)/python -m benchmarks.lmi

.PHONY: corpus
corpus: $(DEV) ## count the verdicts proved on 900 random systems (ten minutes)
	@$(BIN)/python benchmarks/corpus.py

.PHONY: false-accepts
false-accepts: $(DEV) ## look for false proofs: tampered certificates, nearly singular matrices (three minutes)
	@$(BIN)/python -m benchmarks.false_accepts

.PHONY: promises
promises: $(DEV) ## hold what the proofs promise against simulations of 200 random designs
	@$(BIN)/python -m benchmarks.promises 200

.PHONY: peaks
peaks: $(DEV) ## hold enclosed peaks of feedforwards against a fine walk of 100 random specs and the gallery's
	@$(BIN)/python -m benchmarks.peaks 100 600

.PHONY: previews
previews: $(DEV) ## follow references with 100 random plants that are not minimum phase
	@$(BIN)/python -m benchmarks.preview 100
	@$(BIN)/python -m benchmarks.preview grazing 20

.PHONY: bounds
bounds: $(DEV) ## hold the bounds of random designs against the worst that can be found
	@$(BIN)/python -m benchmarks.bounds 200

.PHONY: uncertain
uncertain: $(DEV) ## hold what is said of boxes of parameters against 2,000 random plants (fifteen minutes)
	@$(BIN)/python -m benchmarks.uncertain 2000

.PHONY: practical
practical: $(DEV) ## hold final bounds of practical tracking against simulations of 200 random plants (four minutes)
	@$(BIN)/python -m benchmarks.practical 200

.PHONY: fuzz
fuzz: $(DEV) ## design, simulate and verify 150 random specs (five minutes)
	@$(BIN)/python -m benchmarks.fuzz

.PHONY: fuzz-reader
fuzz-reader: $(PEERS) ## fuzz the reader of specs and formulas, guided by coverage (ten minutes)
	@$(BIN)/python -m benchmarks.fuzz_reader

.PHONY: bad-inputs
bad-inputs: $(DEV) ## check every bad input of the tests in a process of its own: code, line, time, memory (five minutes)
	@$(BIN)/python -m benchmarks.bad_inputs

.PHONY: batch-bench
batch-bench: $(DEV) ## time batches against a process for each spec (ten minutes)
	@$(BIN)/python -m benchmarks.batch

.PHONY: sweep-bench
sweep-bench: $(DEV) ## sweep 1,000 points here and on two dask workers, one killed, against a formula (ten minutes)
	@$(BIN)/python -m benchmarks.sweep

.PHONY: kills
kills: $(DEV) ## kill a batch at 200 random moments and look for harm (ten minutes)
	@$(BIN)/python -m benchmarks.kills

.PHONY: sampled
sampled: $(DEV) ## sample every plant of the specs: errors with either program, and what is proved (five minutes)
	@$(BIN)/python -m benchmarks.sampled_loop $(SPECS)

.PHONY: sampling
sampling: $(DEV) ## simulate 120 random designs at the longest sample time that is stable in every cell (a minute)
	@$(BIN)/python -m benchmarks.sampling 120

.PHONY: export
export: $(DEV) ## compile every spec and 50 random designs, and compare 100,000 steps of each bit by bit
	@$(BIN)/python -m benchmarks.export

.PHONY: coq
coq: $(DEV) ## let Coq check the certificates of all specs, 200 changed ones and a large one (ten minutes)
	@$(BIN)/pwatrack batch specs --plots none --out .venv/.coq >/dev/null
	@$(BIN)/python -m benchmarks.coq .venv/.coq --changed 200 --size 20 64

.PHONY: control-bench
control-bench: $(DEV) ## run the loop of every spec in python-control, and compare (three minutes)
	@$(BIN)/python -m benchmarks.python_control

.PHONY: step-bench
step-bench: $(DEV) ## time a step of exported C against a hand-written loop and python-control
	@$(BIN)/python -m benchmarks.step

FROM ?= boards

.PHONY: boards
boards: $(DEV) ## plants and programs of others, from files in FROM=folder; a page in runs/boards (half an hour)
	@$(BIN)/python -m benchmarks.boards.drivetrain
	@$(BIN)/python -m benchmarks.boards.drivetrain_design
	@$(BIN)/python -m benchmarks.boards.modelica $(FROM)/msl_reference
	@$(BIN)/python -m benchmarks.boards.sdplib $(FROM)/sdplib --vsdp $(FROM)/vsdp/SDPLIB_SYS1.csv
	@$(BIN)/python -m benchmarks.boards.compleib $(FROM)/compleib
	@$(BIN)/python -m benchmarks.boards.page

.PHONY: lint
lint: $(DEV) ## ruff: lint and format
	@$(BIN)/ruff check . && $(BIN)/ruff format --check .

.PHONY: type
type: $(DEV) ## mypy --strict
	@$(BIN)/mypy

.PHONY: imports
imports: $(DEV) ## import-linter: imports only point up the list of rooms
	@$(BIN)/lint-imports

.PHONY: check
check: test-all batch lint type imports ## everything CI runs

.PHONY: format
format: $(DEV) ## let ruff format and fix
	@$(BIN)/ruff check --fix . ; $(BIN)/ruff format .

COMPILE := uv pip compile -q --universal --python-version 3.11 --generate-hashes --no-emit-index-url --no-emit-find-links \
  --custom-compile-command 'make lock' pyproject.toml

.PHONY: lock
lock: ## renew the locks from pyproject.toml (needs uv)
	$(COMPILE) --extra build -o requirements.lock
	$(COMPILE) --extra dev -c requirements.lock -o requirements-dev.lock
	$(COMPILE) --extra docs -c requirements-dev.lock -o docs/requirements.lock

.PHONY: clean
clean: ## remove .venv, runs and caches
	rm -rf .venv runs .pytest_cache .mypy_cache .ruff_cache .hypothesis .import_linter_cache docs/_build docs/generated
