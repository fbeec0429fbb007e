# make demo   set up, train and identify Cartpole, print the results
# make test   set up, lint, type-check and test
# make test-slow   every test, as users compile, with the coverage of lines; hours,
#                  and goes on where it was stopped
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
RUN_STAMP := $(VENV)/.installed
DEV_STAMP := $(VENV)/.installed-dev
DEMO := results/demo
TARGET := 'cart_kp*0.25'
PIP := $(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt

.PHONY: demo test test-slow install install-dev clean

demo: $(RUN_STAMP)
	$(BIN)/python -m train.udr --target $(TARGET) --out $(DEMO)/udr --overwrite
	$(BIN)/python -m train.easi --udr $(DEMO)/udr --target $(TARGET) \
	    --out $(DEMO)/easi --overwrite

test: $(DEV_STAMP)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/pyright
	$(BIN)/python -m pytest -n 2 --dist loadfile --no-loadscope-reorder --durations=10

test-slow: $(DEV_STAMP)
	$(BIN)/python -m benchmarks.slow_tests

install: $(RUN_STAMP)

install-dev: $(DEV_STAMP)

$(BIN)/python:
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || { \
	  echo "error: Python 3.11 or newer is needed; say which: make PYTHON=python3.11 $(MAKECMDGOALS)" >&2; exit 2; }
	$(PYTHON) -m venv $(VENV)

$(RUN_STAMP): pyproject.toml constraints.txt | $(BIN)/python
	$(PIP) -e .
	@touch $@

$(DEV_STAMP): pyproject.toml constraints.txt | $(BIN)/python
	$(PIP) -e '.[dev]'
	@touch $(RUN_STAMP) $@

clean:
	rm -rf $(VENV) $(DEMO) .pytest_cache .ruff_cache
