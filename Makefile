# A fresh clone needs python3 >= 3.11 and make; everything else is put into .venv from requirements.lock.
PYTHON ?= python3
BIN := .venv/bin
STAMP := .venv/.installed-from-lock

PACKAGES ?= yes

# Every process of a run would otherwise compile all modules again, and the tests' assertions.
unexport PYTHONDONTWRITEBYTECODE

# A file's tests run in one process, in the order of tests/conftest.py: what they share is computed once. Three processes on two
# cores, because some tests wait for machines that run by the clock.
PYTEST := $(BIN)/python -m pytest -q -n 3 --dist loadfile --no-loadscope-reorder
# The fast tests hardly ever wait, and every process imports all of them once more.
PYTEST_FAST := $(PYTEST) -n 2

# On the core that lint leaves idle, for about as long as it takes: nearly all tests wait for these, for a twin's estimator many.
KERNELS := import servotwin as st; servo = st.Servo.preset("paper"); \
	[st.simulate(each, 1.0, reference=st.Step(1e-3), gap=0.1, tolerance=1e-5) for each in (servo, servo.replace(sample_rate=1e3))]; \
	run = st.simulate(servo, 1.0, reference=st.Step(1e-3), gap=0.1); st.estimate_gap(st.Window.from_run(run, 0.0, 1.0), servo)

.PHONY: help demo reproduce reference check test fuzz bench lint format lock clean packages kernels

help:
	@echo "make demo       a worn servo loses stability; its digital twin wins it back"
	@echo "make reproduce  every figure and claim of the paper beside what is measured"
	@echo "make check      format, lint, types, layers and the fast tests, two minutes (in a fresh clone five)"
	@echo "make test       the same and all tests, 6 to 30 minutes on two idle cores; as root it installs the Debian packages"
	@echo "                that some tests need (make test PACKAGES=no: skip those tests instead)"
	@echo "make fuzz       the random tests with fresh and with more examples, and the explorations, which make test leaves out"
	@echo "make bench      speed beside other solvers; or: python -m benchmarks NAME"
	@echo "make format     format the code and fix what can be fixed"
	@echo "make reference  write docs/configuration.md and docs/schemas from the code"
	@echo "make lock       pin the dependencies anew (needs uv)"

demo: $(STAMP)
	$(BIN)/servotwin demo

reproduce: $(STAMP)
	$(BIN)/servotwin reproduce

check: $(STAMP)
	@$(MAKE) --no-print-directory -j 2 lint kernels
	$(PYTEST_FAST) -m "not slow and not exploration"

test: $(STAMP)
	@$(MAKE) --no-print-directory -j 3 lint packages kernels
	$(PYTEST)

fuzz: $(STAMP)
	$(PYTEST) -m "hypothesis or random or exploration" --hypothesis-profile=fuzz

bench: $(STAMP)
	$(BIN)/python -m benchmarks

packages:
	@PACKAGES=$(PACKAGES) sh tests/packages.sh

kernels: $(STAMP)
	@$(BIN)/python -c '$(KERNELS)'

lint: $(STAMP)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports

format: $(STAMP)
	$(BIN)/ruff format .
	$(BIN)/ruff check --fix .

reference: $(STAMP)
	$(BIN)/python -m servotwin.cli.configuration docs

lock:
	uv pip compile --quiet pyproject.toml --extra dev --universal --fork-strategy fewest --python-version 3.11 --generate-hashes \
		--no-emit-index-url --no-header --no-annotate -o requirements.lock

clean:
	rm -rf .venv build dist .pytest_cache .mypy_cache .ruff_cache .hypothesis .import_linter_cache

$(STAMP): requirements.lock pyproject.toml
	@$(PYTHON) -c 'import sys; sys.version_info >= (3, 11) or sys.exit("servotwin needs Python 3.11 or newer; $(PYTHON) is " + sys.version.split()[0] + ". Try: make PYTHON=python3.12 ...")'
	@echo "preparing .venv (once, about a minute)"
	@$(PYTHON) -m venv .venv
	@$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-compile --require-hashes -r requirements.lock
	@# pip would compile the tests of all packages too, and with one core; what cannot be compiled is compiled when imported.
	@$(BIN)/python -m compileall -qq -j 0 -x '/tests?/' .venv/lib || true
	@$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-deps --no-build-isolation -e .
	@touch $@
