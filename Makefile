# Each target makes the environment that it needs, from nothing but Python 3.11 or newer.
PYTHON ?= python3
VENV ?= .venv
BIN := $(VENV)/bin

.PHONY: demo test lint bench docs clean

demo: $(VENV)/.ready  ## learn to pick up a ball and throw it, in two minutes; ends with a curve and a GIF
	$(BIN)/torchrl-her train preset=demo

test: $(VENV)/.ready-test  ## all tests and doctests
	$(BIN)/python -m pytest $(TESTS)

lint: $(VENV)/.ready-test  ## style, formatting, types
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

bench: $(VENV)/.ready-bench  ## all benchmarks, beside peers, in one report: runs/bench.md
	$(BIN)/python benchmarks/run.py

docs: $(VENV)/.ready-docs  ## the documentation as a site: build/docs/index.html
	$(BIN)/python -m sphinx -W --keep-going docs build/docs

clean:
	rm -rf $(VENV)

$(VENV)/.ready: EXTRAS :=
$(VENV)/.ready-test: EXTRAS := [test,lint,video]
$(VENV)/.ready-bench: EXTRAS := [bench]
$(VENV)/.ready-docs: EXTRAS := [docs]
$(VENV)/.ready $(VENV)/.ready-test $(VENV)/.ready-bench $(VENV)/.ready-docs: pyproject.toml
	@$(PYTHON) -c 'import sys; sys.exit("Python 3.11 or newer is needed, this is " + sys.version.split()[0] + "; set PYTHON=") if sys.version_info < (3, 11) else None'
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet uv  # installs torch in seconds; pip is the way out where it cannot
	VIRTUAL_ENV=$(abspath $(VENV)) $(BIN)/uv pip install --quiet --editable '.$(EXTRAS)' \
		|| $(BIN)/python -m pip install --quiet --editable '.$(EXTRAS)'
	touch $@
