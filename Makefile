# Each target makes the virtual environment that it needs, from nothing but Python 3.11 or newer.
PYTHON ?= python3
VENV ?= .venv
WORKERS ?= logical
BIN := $(VENV)/bin
# Each worker computes in one thread: more of them only wait for each other. Without bytecode, as containers like
# to have it, each process that a test starts would compile all of torch, which takes six seconds.
PYTEST := OMP_NUM_THREADS=1 PYTHONDONTWRITEBYTECODE= $(BIN)/python -m pytest --numprocesses $(WORKERS) --dist worksteal --durations=15

.PHONY: demo shell test test-full test-versions lint bench bench-gpu wheel check-dist release docs clean
.SILENT:

demo: $(VENV)/.ready  ## learn to pick up a ball and throw it, in a minute; ends with a curve and a GIF
	test -n "$$CXX$$(command -v g++; command -v clang++; command -v c++)" || { \
		echo "There is no C++ compiler: installing ziglang, which has one"; \
		$(BIN)/python -m pip install --quiet ziglang || true; }
	$(BIN)/torchrl-her train preset=demo

shell: $(VENV)/.ready  ## a shell in which torchrl-her can be called
	VIRTUAL_ENV=$(abspath $(VENV)) PATH="$(abspath $(BIN)):$$PATH" $${SHELL:-sh}

test: $(VENV)/.ready-test  ## tests and doctests; those of some files or folders only: make test TESTS=tests/envs
	$(PYTEST) $(TESTS)

test-full: $(VENV)/.ready-test  ## the same, and the tests marked "full", which take much longer
	$(PYTEST) -m "" $(TESTS)

test-versions: $(VENV)/.ready-test  ## lowest, mixed and newest torch and TorchRL, and each Python, in environments of their own
	$(BIN)/python .ci/try_versions.py $(TESTS)

lint: $(VENV)/.ready-test  ## style, formatting, who imports whom, types
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/lint-imports
	$(BIN)/mypy

bench: $(VENV)/.ready-bench  ## all benchmarks, beside peers, in one report: runs/bench.md
	$(BIN)/python benchmarks/run.py

bench-gpu: $(VENV)/.ready  ## what a GPU gives, in less than ten minutes: runs/bench_gpu.md
	mkdir -p runs
	$(BIN)/python benchmarks/gpu.py --out runs/bench_gpu.md

wheel: $(BIN)/uv  ## source distribution and a wheel with C++ code compiled for this kind of machine: dist/
	rm -rf dist
	HATCH_BUILD_HOOK_ENABLE_CUSTOM=1 $(BIN)/uv build --python $(BIN)/python

check-dist: $(BIN)/uv  ## metadata of what is in dist/, by twine
	$(BIN)/uv tool run twine check --strict dist/*

release: $(VENV)/.ready-test  ## builds what is published, checks it and tries it in new environments; uploads nothing
	$(BIN)/python .ci/release.py $(TAG)

docs: $(VENV)/.ready-docs  ## the documentation as a site, with the studies' pages: build/docs/index.html
	$(BIN)/python -m sphinx -W --keep-going docs build/docs

clean:
	rm -rf $(VENV)

$(VENV)/.ready: EXTRAS :=
$(VENV)/.ready-test: EXTRAS := [test,lint,video]
$(VENV)/.ready-bench: EXTRAS := [bench]
# The reference imports searches, too.
$(VENV)/.ready-docs: EXTRAS := [docs,report,tune]
$(BIN)/uv:  # installs torch in seconds
	$(PYTHON) -c 'import sys; sys.exit("Python 3.11 or newer is needed, this is " + sys.version.split()[0] + "; set PYTHON=") if sys.version_info < (3, 11) else None'
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet uv

# pip is the way out where uv cannot.
$(VENV)/.ready $(VENV)/.ready-test $(VENV)/.ready-bench $(VENV)/.ready-docs: pyproject.toml | $(BIN)/uv
	echo "Installing into $(VENV): about 6 GB, most of it for CUDA; UV_TORCH_BACKEND=cpu takes far less"
	VIRTUAL_ENV=$(abspath $(VENV)) $(BIN)/uv pip install --editable '.$(EXTRAS)' \
		|| $(BIN)/python -m pip install --quiet --editable '.$(EXTRAS)'
	touch $@
