# make         environment, build, and the main job: identify a beam's material
# make test    the quick tests, a process for each core (ARGS='-k floor' and the like are passed to pytest)
# make test-all  the slow tests, too; ARGS='-m hours' instead: what is run by hand before a release
# make lint    ruff, pyright and clang-format in check mode
# make docs    the site into build/docs, warnings are errors; tutorials are executed (NOTEBOOKS=off: not)
# make linkcheck  addresses of other sites in docs/ (needs the internet)
# make wheels  sdist and CPU wheel into dist/ (minutes); `make try-wheels` runs the wheel in new environments
# make clean   remove what the build made; `make distclean` removes the environment too
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
ARGS ?=
NOTEBOOKS ?= cache

# Idle OpenMP threads sleep instead of spinning; read when torch is loaded, so it is set here.
export OMP_WAIT_POLICY ?= PASSIVE
# The build finds ninja through PATH only; without it the sources compile one after another.
export PATH := $(CURDIR)/$(BIN):$(PATH)

ENVIRONMENT := $(VENV)/environment.stamp
TUTORIALS := $(VENV)/tutorials.stamp
NATIVE := diffvbd/_C.abi3.so
SOURCES := $(shell find csrc -type f -name '*.h' -o -type f -name '*.cpp' -o -type f -name '*.cu*')

.PHONY: run build test test-all lint docs linkcheck wheels try-wheels clean distclean

run: build
	$(BIN)/python -m diffvbd run beam-mu $(ARGS)

build: $(ENVIRONMENT) $(NATIVE)

test: build
	$(BIN)/python -m pytest -n auto --dist worksteal $(ARGS)

test-all: build
	$(BIN)/python -m pytest -n auto --dist worksteal -m "not hours" $(ARGS)

lint: $(ENVIRONMENT)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/pyright
	$(BIN)/clang-format --dry-run -Werror $(SOURCES)

docs: build $(if $(filter off,$(NOTEBOOKS)),,$(TUTORIALS))
	$(BIN)/python -m sphinx -q -E -W --keep-going -b html -d build/doctrees -D nb_execution_mode=$(NOTEBOOKS) docs build/docs $(ARGS)

linkcheck: build
	$(BIN)/python -m sphinx -q -b linkcheck docs build/linkcheck $(ARGS)

wheels:
	$(PYTHON) .ci/wheels.py build $(ARGS)

try-wheels:
	$(PYTHON) .ci/wheels.py try $(ARGS)

$(ENVIRONMENT): .ci/bootstrap.py pyproject.toml
	$(PYTHON) .ci/bootstrap.py $(VENV)
	@echo "building diffvbd and installing its tools (some 3 minutes on 2 cores)"
	$(BIN)/python -m pip install -qq --disable-pip-version-check --no-build-isolation -e ".[dev]"
	@touch $@

# What executing the tutorials takes beyond the environment. diffvbd itself is there already: pip adds the extra only.
$(TUTORIALS): $(ENVIRONMENT)
	$(BIN)/python -m pip install -qq --disable-pip-version-check --no-build-isolation "diffvbd[docs]"
	@touch $@

# pip has just built it in a new environment. Later this recompiles only what an edit concerns (--force: setuptools
# itself looks at no header; ninja does).
$(NATIVE): $(SOURCES) setup.py diffvbd/ops/build_cuda.py | $(ENVIRONMENT)
	$(BIN)/python setup.py --quiet build_ext --inplace --force
	@touch $@

clean:
	rm -rf build dist diffvbd/*.so *.egg-info .pytest_cache .ruff_cache .hypothesis
	find diffvbd tests -name __pycache__ -type d -prune -exec rm -rf {} +

distclean: clean
	rm -rf $(VENV)
