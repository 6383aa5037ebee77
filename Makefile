# Each target does its own set-up and is quick when nothing changed.
PYTHON ?= python3
BIN := .venv/bin
OUT ?= out/demo
# Waiting threads sleep: tests and benchmarks share the machine.
export OMP_WAIT_POLICY ?= PASSIVE
CPP := $(shell git ls-files 'gsplat_core/*.cpp' 'gsplat_core/*.h')

.PHONY: demo test lint format bench native lock licences clean

demo: native
	$(BIN)/intrasplat synthesize --out out/recording
	$(BIN)/intrasplat replay out/recording --out $(OUT)

test: native .venv/.development
	$(BIN)/python -m pytest

lint: .venv/.development
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/clang-format --dry-run --Werror $(CPP)
	$(BIN)/mypy

format: .venv/.development
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .
	$(BIN)/clang-format -i $(CPP)

bench: native .venv/.development
	benchmarks/run_all.sh

# Rebuilds the C++ core where its sources changed; a no-op otherwise.
native: .venv/.runtime
	@$(BIN)/cmake --build build/editable | grep -v "no work to do" || true

# The build tools come first, so that the install builds against the torch that it will run with.
.venv/.runtime: requirements.lock pyproject.toml
	test -x $(BIN)/python || $(PYTHON) -m venv .venv
	$(BIN)/pip install --quiet --require-hashes -r requirements.lock
	$(BIN)/pip install --quiet --no-build-isolation --no-deps --editable .
	touch $@

.venv/.development: requirements-dev.lock .venv/.runtime
	$(BIN)/pip install --quiet --require-hashes -r requirements-dev.lock
	touch $@

lock: .venv/.development
	$(BIN)/uv pip compile pyproject.toml --extra build --universal --generate-hashes --quiet --no-emit-index-url -o requirements.lock
	$(BIN)/uv pip compile pyproject.toml --extra build --extra dev --extra holoscan --universal --generate-hashes --quiet --no-emit-index-url -c requirements.lock -o requirements-dev.lock

licences: .venv/.development
	$(BIN)/python deploy/third_party_licences.py

clean:
	rm -rf build gsplat_core/*.so .venv
