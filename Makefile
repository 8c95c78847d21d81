# The project's commands.  Only Python 3.11 (or newer) and make need to be there;
# `make run` and `make test` set up what they need in .venv, once.

PYTHON = python3
HOST = 127.0.0.1
PORT ?= 8000
# Batches per mission in the demonstration; empty: its own default.
BATCHES ?=
# Further arguments, e.g. make test PYTEST_ARGS="-k quest -x"
DEMO_ARGS ?=
PYTEST_ARGS ?=
# Of `make torture`: an expression as pytest -k has it, e.g. "kills and sqlite"; empty: all
PARTS ?=
# Processes that share the tests between them, a file to each at a time, of 2 GB; 0 for one after
# another.  Three for two cores: many tests wait for a process of their own.
WORKERS ?= $(shell echo $$(($$(getconf _NPROCESSORS_ONLN) * 3 / 2)))
BENCH_ARGS ?=
# Of `make mutants`: e.g. "--seed 2 --suite sitting"; --help says more
MUTANTS_ARGS ?=
# What comes to the database only after it was checked, or in a browser, is the same over both
ALL_OVER_POSTGRESQL = tests/web tests/features \
	$(addprefix --ignore tests/web/test_,bad_input.py any_input.py console_in_browser.py)
# What asks the database in a way of its own.
SITTING_OVER_POSTGRESQL = $(addprefix tests/web/test_,batches.py bulk.py events.py history.py \
	many_batches.py period.py revisions_and_runs.py trackers.py)
OVER_POSTGRESQL = [ -z "$$TEST_POSTGRESQL_URL" ] || \
	$(TEST) --database postgresql -m "not torture"
# From the environment: TEST_POSTGRESQL_URL, a scratch database for the PostgreSQL tests, which
# are skipped without it, e.g. postgresql+psycopg://user@127.0.0.1:5432/test

# With it every start of a process compiles each of its modules anew: two seconds of a service.
unexport PYTHONDONTWRITEBYTECODE

VENV = .venv
BIN = $(VENV)/bin
PIP = $(BIN)/python -m pip install --quiet --disable-pip-version-check
# Not quiet: it says what it downloads, with sizes.
UV = $(BIN)/uv pip install --python $(BIN)/python
COMPILE = $(BIN)/uv pip compile --quiet --universal --python-version 3.11 --generate-hashes --no-header

IMAGE_EXTRAS = postgresql nats sign spice tle packets tables dask plots images raw

RUNTIME = $(VENV)/.installed-runtime
DEV = $(VENV)/.installed-dev

.DEFAULT_GOAL = help
.PHONY: help install run test full kernels torture mutants check static format-check lint types floors \
	migrations-check openapi-check client client-check \
	format lock bench compare stale pythons dist openapi clean

help:
	@echo "make install  set up the service and its client in .venv, for the command .venv/bin/acquire"
	@echo "make run      set up, serve on http://$(HOST):$(PORT), replay sample telemetry, print a table"
	@echo "make test     set up and run the tests of a sitting (minutes)"
	@echo "make full     run all tests (an hour)"
	@echo "make torture  kills, failing disks, odd input at full size (hours; goes on where it"
	@echo "              stopped); PARTS=\"kills and sqlite\" for some, as pytest -k has it"
	@echo "make mutants  give the service 60 single faults, one at a time, and say which of them"
	@echo "              the tests miss (hours; goes on where it stopped)"
	@echo "make check    tests, format, lint, types, import floors, migrations, openapi.yaml, client"
	@echo "make format   format the code and mend what the linter can"
	@echo "make bench    measure speed, write docs/performance.md; BENCH_ARGS=--all for all benchmarks"
	@echo "make compare  send the same inputs to this version and to BASE=commit, show differences"
	@echo "make stale    name the measured sections of the documents that are older than the code"
	@echo "make pythons  run the wheel under each supported Python that is here (minutes each)"
	@echo "make dist     write the wheels, source archive and bill of materials to dist/"
	@echo "make openapi  write openapi.yaml anew"
	@echo "make client   write the client's models and its synchronous half anew"
	@echo "make lock     resolve the dependencies anew (needs the package index)"
	@echo "make clean    remove .venv and everything that was built or cached"
	@echo
	@echo "Variables: PORT, HOST, BATCHES, PYTHON, WORKERS, TEST_POSTGRESQL_URL,"
	@echo "           DEMO_ARGS, PYTEST_ARGS, PARTS, MUTANTS_ARGS, BENCH_ARGS, BASE, COMPARE_ARGS"

install: $(RUNTIME)

run: $(RUNTIME)
	@exec $(BIN)/acquire demo --host $(HOST) --port $(PORT) $(if $(BATCHES),--batches $(BATCHES)) $(DEMO_ARGS)

TEST = $(BIN)/python -m pytest --numprocesses $(WORKERS) --maxprocesses 8 --dist loadfile

test: kernels
	@echo "== tests"
	@$(TEST) $(PYTEST_ARGS)
	@$(if $(PYTEST_ARGS),:,$(OVER_POSTGRESQL) $(SITTING_OVER_POSTGRESQL))

# Its longest tests take minutes, and more on a busy machine.
FULL = --full -o faulthandler_timeout=1200
full: kernels
	@echo "== all tests"
	@$(TEST) $(FULL) $(PYTEST_ARGS)
	@$(if $(PYTEST_ARGS),:,$(OVER_POSTGRESQL) $(FULL) $(ALL_OVER_POSTGRESQL))

kernels: $(DEV)
	@echo "== kernels and sky (minutes after a change of the core, else seconds)"
	@$(BIN)/acquire prepare

torture: $(DEV)
	@echo "== torture: kills, failing disks and odd input at full size; hours"
	@echo "== results are in .torture; what passed with the same code is left out"
	@$(BIN)/python -m pytest -p tests.torture --torture -m torture $(if $(PARTS),-k "$(PARTS)") $(PYTEST_ARGS)

mutants: $(DEV)
	@$(BIN)/python -m tests.mutants $(MUTANTS_ARGS)

# What needs no test run goes beside the tests.
check: $(DEV)
	@$(MAKE) --no-print-directory --jobs 2 test static
	@echo "== all checks passed"

static: $(DEV)
	@MAKEFLAGS= $(MAKE) --no-print-directory format-check lint types floors migrations-check openapi-check client-check

format-check: $(DEV)
	@echo "== format"
	@$(BIN)/ruff format --check --quiet

lint: $(DEV)
	@echo "== lint"
	@$(BIN)/ruff check --quiet

types: $(DEV)
	@echo "== types"
	@$(BIN)/mypy

floors: $(DEV)
	@echo "== import floors"
	@$(BIN)/lint-imports --no-logo

migrations-check: $(DEV)
	@echo "== migrations"
	@$(BIN)/acquire database check --fresh

openapi-check: $(DEV)
	@echo "== openapi.yaml"
	@$(BIN)/acquire openapi --check

client-check: $(DEV)
	@echo "== generated parts of the client"
	@$(BIN)/python client/generate.py --check

format: $(DEV)
	@$(BIN)/ruff format
	@$(BIN)/ruff check --fix

bench: $(DEV)
	@$(BIN)/python -m benchmarks --write $(BENCH_ARGS)

compare: $(DEV)
	@test -n "$(BASE)" || { echo "Name a commit: make compare BASE=main"; exit 2; }
	@$(BIN)/python -m benchmarks.compare --base "$(BASE)" $(COMPARE_ARGS)

# Before a release; not part of `make check`, because measuring everything again takes hours.
stale: $(DEV)
	@$(BIN)/python -m benchmarks.verification --check

pythons: $(DEV)
	@$(BIN)/python -m tests.pythons

# The bill of materials is made by a tool in an environment of its own, which needs the package index.
dist: $(DEV)
	@rm -rf dist
	@UV_PYTHON=$(BIN)/python $(BIN)/uv build --no-build-isolation --quiet --out-dir dist
	@for part in client studies; do \
		UV_PYTHON=$(BIN)/python $(BIN)/uv build --no-build-isolation --quiet --wheel --out-dir dist $$part || exit 1; \
	done
	@$(BIN)/uv tool run --quiet --from cyclonedx-bom==7.5.0 cyclonedx-py requirements \
		--pyproject pyproject.toml --output-reproducible --output-file dist/bill-of-materials.cdx.json \
		requirements.lock
	@cd dist && rm -f .gitignore && sha256sum * > SHA256SUMS && cat SHA256SUMS

# Written beside and then moved: a failure leaves the old file.
openapi: $(DEV)
	@$(BIN)/acquire openapi > openapi.yaml.new && mv openapi.yaml.new openapi.yaml || { rm -f openapi.yaml.new; exit 1; }

# From the records of the service, and the synchronous half from the asynchronous one.
client: $(DEV)
	@$(BIN)/python client/generate.py

# The second lock is bound to the first, so that one .venv serves both.
lock: $(DEV)
	@$(COMPILE) --upgrade --group build --extra postgresql --output-file requirements.lock pyproject.toml
	@$(COMPILE) --group build $(addprefix --extra ,$(IMAGE_EXTRAS)) --constraint requirements.lock \
		--output-file docker/requirements.lock pyproject.toml
	@$(COMPILE) --upgrade --group dev --extra postgresql --constraint requirements.lock \
		--output-file requirements-dev.lock pyproject.toml

clean:
	rm -rf $(VENV) build dist .mypy_cache .ruff_cache .pytest_cache .hypothesis .import_linter_cache
	find . -name __pycache__ -type d -prune -exec rm -rf {} +

$(BIN)/python:
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
		{ echo "Python 3.11 or newer is needed; name one with: make PYTHON=/path/to/python3.11"; exit 1; }
	@$(PYTHON) -c 'import ensurepip, venv' 2>/dev/null || \
		{ echo "Python's venv module is missing (on Debian: apt-get install python3-venv)"; exit 1; }
	@echo "Setting up $(VENV)"
	@$(PYTHON) -m venv $(VENV)

# $(1): lock file.  Every file is checked against its hash; the project itself is linked in place.
# uv installs in seconds what pip takes a minute for.  pip does it on a machine that uv has no wheel
# for, or where uv reaches no index (pip's own settings may name one).
define install
	@echo "Installing the packages of $(1) into $(VENV) (once)"
	@[ -x $(BIN)/uv ] || awk '/^[a-z]/ { wanted = /^uv==/ } wanted' requirements-dev.lock | \
		$(PIP) --only-binary :all: --require-hashes --requirement /dev/stdin || true
	@{ $(UV) --require-hashes --requirement $(1) && $(UV) --no-deps --no-build-isolation --editable . --editable ./studies; } || \
		{ echo "uv cannot; pip takes about a minute"; \
		$(PIP) --require-hashes --requirement $(1) && $(PIP) --no-deps --no-build-isolation --editable . --editable ./studies; }
	@echo "$$(ls -d $(VENV)/lib/python*/site-packages/*.dist-info | wc -l) packages," \
		"$$(du -sm $(VENV) | cut -f1) MB unpacked"
endef

$(RUNTIME): requirements.lock pyproject.toml studies/pyproject.toml | $(BIN)/python
	$(call install,requirements.lock)
	@touch $@

# Holds the runtime packages too, in the same versions.
$(DEV): requirements-dev.lock requirements.lock pyproject.toml studies/pyproject.toml | $(BIN)/python
	$(call install,requirements-dev.lock)
	@touch $(RUNTIME) $@
