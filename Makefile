# Each target does its own set-up and takes little time if nothing changed.
PYTHON ?= python3
BIN := .venv/bin
OUT ?= out/demo
EXAMPLES ?= 200
MUTANTS ?= 60
# Idle threads sleep instead of spinning, because tests and benchmarks share the machine.
export OMP_WAIT_POLICY ?= PASSIVE
MODULES := $(wildcard $(sort $(shell git ls-files --cached --others --exclude-standard 'gsplat_core/*.py' 'operators/*.py' 'services/*.py')))
CPP := $(shell git ls-files 'gsplat_core/*.cpp' 'gsplat_core/*.h' 'gsplat_core/*.cu' 'gsplat_core/*.cuh')
# Target GPUs of `make cuda`: `native` (this machine), `portable` (compute capability 8.0 and later), or a list in CMake's notation
# (80-real;90-real).
CUDA_ARCHITECTURES ?= native
CUDA_TOOLKIT := build/cuda-toolkit

.PHONY: demo results mutants test test-all test-again test-isa lint format fuzz bench native cuda compilers lock licences sbom clean always

# Runs on the NVIDIA GPU if torch can use one. The CUDA kernels are built first; a failed build ends the target.
demo: native
	$(BIN)/intrasplat synthesize --out out/recording --frames 90 --behind
	@set -e; if $(BIN)/python -m services.cli.doctor; then device=cuda; $(MAKE) --no-print-directory cuda; else device=cpu; fi; \
	  set -x; $(BIN)/intrasplat replay out/recording --out $(OUT) --depth stereo --device $$device

# Run the fast tests (`test`), or also those marked as slow (`test-all`), in groups of which JOBS run at a time. `tests/groups.py` has the
# groups. Child processes of tests load compiled modules instead of compiling them again.
TESTS = PYTHONDONTWRITEBYTECODE= $(BIN)/python -m tests.groups
test: native .venv/.development
	@$(TESTS) --fast $(JOBS:%=--jobs %)

test-all: native .venv/.development
	@$(TESTS) $(JOBS:%=--jobs %)

# Run the tests that failed in the last run once more, one group at a time, and only if the groups ended with failed tests.
test-again: native .venv/.development
	@$(TESTS) --again

# The numeric tests with each instruction set of this processor, in torch, its BLAS, numpy's BLAS and our own kernels.
test-isa: native .venv/.development
	tests/instruction_sets.sh

lint: .venv/.development
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/clang-format --dry-run --Werror $(CPP)
	$(BIN)/mypy

format: .venv/.development
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .
	$(BIN)/clang-format -i $(CPP)

# Fuzz the API of a real server with schemathesis: EXAMPLES valid and invalid calls of each operation.
fuzz: native .venv/.development
	$(BIN)/python -m tests.system.api_fuzzing --examples $(EXAMPLES)

# Measure this machine into benchmarks/logs/cpu. `make results` generates RESULTS.md, the generated pages of benchmarks/results and the README's tables from the logs.
bench: native .venv/.development
	$(BIN)/python benchmarks/suite.py --device cpu
	$(BIN)/python benchmarks/publish.py

results: .venv/.development
	$(BIN)/python benchmarks/publish.py

# One-line changes of the product, each with the tests that reach it: the share that is noticed.
mutants: native .venv/.development
	$(BIN)/python -m tests.mutants --count $(MUTANTS)

# Rebuild the C++ core if its sources changed or its build folder was deleted.
native: .venv/.runtime
	@test -f build/editable/build.ninja || $(BIN)/pip install --quiet --no-build-isolation --no-deps --editable .
	@$(BIN)/cmake --build build/editable -- --quiet

# Build the CUDA kernels with NVIDIA's compiler from pip, in a separate folder without torch, or with the nvcc in CUDACXX.
cuda: .venv/.runtime $(if $(strip $(CUDACXX)),,$(CUDA_TOOLKIT)/.installed)
	@$(BIN)/cmake -S . -B build/cuda -G Ninja -DINTRASPLAT_CUDA=ON -DINTRASPLAT_INPLACE=ON \
	  -DINTRASPLAT_CUDA_ARCHITECTURES="$(CUDA_ARCHITECTURES)" -DPython_EXECUTABLE=$(CURDIR)/$(BIN)/python \
	  -DCMAKE_MAKE_PROGRAM=$(CURDIR)/$(BIN)/ninja --log-level=WARNING
	@$(BIN)/cmake --build build/cuda --target gsplat_core_cuda

$(CUDA_TOOLKIT)/.installed: requirements-cuda.lock | .venv/.runtime
	rm -rf $(CUDA_TOOLKIT)
	$(BIN)/pip install --quiet --require-hashes --no-deps --target $(CUDA_TOOLKIT) -r requirements-cuda.lock
	touch $@

# Compile the host code of both libraries with every C++ compiler of this machine; warnings are errors.
compilers: .venv/.runtime
	@.ci/compilers

# Install the packages of a lock by uv, or by pip where uv cannot reach the package index that pip is configured for.
install = $(BIN)/uv pip install --quiet --python $(BIN)/python --require-hashes -r $(1) || $(BIN)/pip install --quiet --require-hashes -r $(1)

# uv, from the lock of the development tools. It installs in parallel, in a third of pip's time.
.venv/.installer: requirements-dev.lock
	test -x $(BIN)/python || $(PYTHON) -m venv .venv
	awk '/^[^ #]/ { own = /^uv==/ } own' requirements-dev.lock > .venv/uv.lock
	$(BIN)/pip install --quiet --require-hashes -r .venv/uv.lock
	touch $@

.venv/.dependencies: requirements.lock | .venv/.installer
	$(call install,requirements.lock)
	touch $@

# The installed package contains a list of modules. This file has the same list and changes when a module is added, moved or removed.
build/modules.txt: always
	@mkdir -p build
	@printf '%s\n' $(MODULES) | cmp --quiet - $@ || printf '%s\n' $(MODULES) > $@

# Build tools are installed first, so that the core is built against the torch that it runs with.
.venv/.runtime: .venv/.dependencies pyproject.toml build/modules.txt
	$(BIN)/pip install --quiet --no-build-isolation --no-deps --editable .
	touch $@

.venv/.development: requirements-dev.lock .venv/.dependencies | .venv/.runtime
	$(call install,requirements-dev.lock)
	touch $@

lock: .venv/.development
	$(BIN)/uv pip compile pyproject.toml --extra build --universal --generate-hashes --quiet --no-emit-index-url -o requirements.lock
	$(BIN)/uv pip compile pyproject.toml --extra build --extra postgresql --extra s3 --extra oidc --universal --generate-hashes --quiet --no-emit-index-url -c requirements.lock -o requirements-service.lock
	$(BIN)/uv pip compile pyproject.toml --extra build --extra dev --extra holoscan --universal --generate-hashes --quiet --no-emit-index-url -c requirements.lock -o requirements-dev.lock
	$(BIN)/python -c "import tomllib; print(*tomllib.load(open('pyproject.toml', 'rb'))['project']['optional-dependencies']['cuda-build'], sep='\n')" \
	  | $(BIN)/uv pip compile - --no-deps --universal --generate-hashes --quiet --no-emit-index-url --no-annotate \
	    --custom-compile-command "make lock (the compiler of make cuda, installed without dependencies)" -o requirements-cuda.lock

# Write the packages of the images as CycloneDX: name, version, digests and address of each package in the service's lock.
sbom: .venv/.development
	@mkdir -p out
	$(BIN)/cyclonedx-py requirements requirements-service.lock --pyproject pyproject.toml --output-reproducible --of JSON -o out/sbom.json

licences: .venv/.development
	$(BIN)/python deploy/third_party_licences.py

clean:
	rm -rf build gsplat_core/*.so .venv
