# The verbs of this project. The first `make` builds .venv from the hashed lock; later ones find their stamps and start at once.

PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
RUN := $(BIN)/python -m
PIP := $(RUN) pip --disable-pip-version-check -q
VIEWER := client/viewer
PAGE := $(VIEWER)/dist/.stamp
PAGE_SOURCES := $(shell find $(VIEWER)/src -type f) $(addprefix $(VIEWER)/,package-lock.json build.mjs index.html)

.DELETE_ON_ERROR:
.PHONY: install demo test nightly lint bench lock clean

install: $(VENV)/.app $(PAGE)

demo: install
	$(BIN)/foveascan demo $(ARGS)

test: install
	$(RUN) pytest -q -n auto --dist loadfile $(ARGS)

nightly: install
	$(BIN)/python tests/nightly/machine.py $(ARGS)

lint: install
	$(BIN)/ruff check .
	$(RUN) mypy
	$(BIN)/lint-imports
	$(BIN)/python hatch_build.py check

bench: install
	$(BIN)/foveascan bench $(ARGS)

# Resolves pyproject.toml and requirements.in anew. Commit what it writes.
lock: $(VENV)/.pip
	$(PIP) install uv
	$(RUN) uv -q pip compile --upgrade --universal --python-version 3.11 --fork-strategy fewest --generate-hashes --no-annotate --no-header \
		--no-emit-index-url --no-emit-find-links --extra dev pyproject.toml requirements.in -o constraints.txt > /dev/null
	$(BIN)/python -c 'import hatch_build; print(hatch_build.NODE_WHEEL)' | $(RUN) uv -q pip compile --upgrade --universal --python-version 3.11 \
		--generate-hashes --no-annotate --no-header --no-emit-index-url - -o constraints-node.txt > /dev/null

clean:
	rm -rf $(VENV) .nightly dist $(VIEWER)/dist $(VIEWER)/node_modules .pytest_cache .mypy_cache .ruff_cache .import_linter_cache .hypothesis
	find . -name __pycache__ -type d -prune -exec rm -rf {} +

$(VENV)/.pip:
	@command -v $(PYTHON) > /dev/null || { echo "foveascan: no $(PYTHON) here; name a Python of 3.11 or newer: make PYTHON=/path/to/python3" >&2; exit 2; }
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
	{ echo "foveascan: $$($(PYTHON) -V 2>&1) is too old, 3.11 or newer is needed: make PYTHON=/path/to/python3.11" >&2; exit 2; }
	@$(PYTHON) -c 'import ensurepip, venv' 2> /dev/null || \
	{ echo "foveascan: $(PYTHON) cannot make a virtual environment; as root: apt-get install python3-venv" >&2; exit 2; }
	@rm -rf $(VENV)
	@$(PYTHON) -m venv $(VENV)
	@touch $@

$(VENV)/.deps: constraints.txt $(VENV)/.pip
	@echo "foveascan: installing the locked packages into $(VENV), about a minute the first time"
	@$(PIP) install --require-hashes -r constraints.txt
	@touch $@

$(PAGE): $(PAGE_SOURCES) hatch_build.py | $(VENV)/.deps
	@if [ -n "$$($(BIN)/python hatch_build.py requires)" ]; then $(PIP) install --require-hashes -r constraints-node.txt; fi
	@$(BIN)/python hatch_build.py build
	@touch $@

$(VENV)/.app: pyproject.toml hatch_build.py $(VENV)/.deps | $(PAGE)
	@$(PIP) install --no-deps --no-build-isolation -e .
	@touch $@
