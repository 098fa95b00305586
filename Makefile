# `make report` and `make test` set up what they need: a virtual environment in .venv with the versions of
# constraints.txt, which are the ones that are tested. Remake it with `make clean`.

PYTHON ?= python3
OUT ?= out
BIN := .venv/bin

.PHONY: report report-full test test-slow coverage check format docs build clean

report: .venv/ready  ## the main job: the paper's controllers, reproduced, as one HTML page
	$(BIN)/cpjax report --out $(OUT)/report

report-full: .venv/ready  ## the same with finer maps and full fronts: some fifteen minutes
	$(BIN)/cpjax report --count 10000 --cells 512 --studies full --out $(OUT)/report-full

# Most of its time is spent on compiling what then runs for milliseconds, so the compiler optimises less. The slow tests
# and tests/backend run what users run.
COMPILE_FASTER := JAX_DISABLE_MOST_OPTIMIZATIONS=1 XLA_FLAGS=--xla_cpu_use_fusion_emitters=false

test: check  ## linter, type checker, tests with warnings as errors
	$(COMPILE_FASTER) $(BIN)/python -m pytest -n 2 --dist worksteal --ignore tests/backend
	$(BIN)/python -m pytest -n 2 tests/backend

test-slow: .venv/ready-test  ## the tests that take minutes
	$(BIN)/python -m pytest -n 2 -m slow

coverage: .venv/ready-test  ## the lines and branches of cpjax/ that the tests of `make test` reach
	$(COMPILE_FASTER) $(BIN)/python -m pytest -n 2 --dist worksteal --cov

check: .venv/ready-test
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/mypy --num-workers 2

format: .venv/ready-test  ## puts the code into the form that `make check` wants
	$(BIN)/ruff format .
	$(BIN)/ruff check --fix .

docs: .venv/ready-test  ## the documentation as pages in build/site, strictly
	$(BIN)/mkdocs build --strict

build: .venv/ready-test  ## sdist and wheel in dist/
	$(BIN)/python -m build --outdir dist

clean:
	rm -rf .venv build dist .mypy_cache .ruff_cache .pytest_cache .coverage*

.venv/bin/python:
	$(PYTHON) -c 'import sys; sys.exit(None if sys.version_info >= (3, 11) else "cpjax needs Python 3.11 or newer; this is " + sys.version.split()[0] + ". Use: make PYTHON=python3.11")'
	$(PYTHON) -m venv .venv

.venv/ready: .venv/bin/python pyproject.toml constraints.txt
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --constraint constraints.txt --editable .
	touch $@

.venv/ready-test: .venv/ready
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --constraint constraints.txt --editable '.[test,peers]'
	touch $@
