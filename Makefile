# make         environment, build, and the main job: identify a beam's material
# make test    the default test suite (ARGS='-m slow' and the like are passed to pytest)
# make lint    ruff, pyright and clang-format in check mode
# make clean   remove what the build made; `make distclean` removes the environment too
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
ARGS ?=

# Idle OpenMP threads sleep instead of spinning; read when torch is loaded, so it is set here.
export OMP_WAIT_POLICY ?= PASSIVE

ENVIRONMENT := $(VENV)/environment.stamp
BUILD := $(VENV)/build.stamp
NATIVE := $(shell find csrc -type f -name '*.h' -o -type f -name '*.cpp' -o -type f -name '*.cu')

.PHONY: run build test lint clean distclean

run: $(BUILD)
	$(BIN)/python -m diffvbd run beam-mu $(ARGS)

build: $(BUILD)

test: $(BUILD)
	$(BIN)/python -m pytest $(ARGS)

lint: $(BUILD)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/pyright
	$(BIN)/clang-format --dry-run -Werror $(NATIVE)

$(ENVIRONMENT): .ci/bootstrap.py
	$(PYTHON) .ci/bootstrap.py $(VENV)
	@touch $@

$(BUILD): $(ENVIRONMENT) pyproject.toml setup.py $(NATIVE)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-build-isolation -e ".[dev]"
	@touch $@

clean:
	rm -rf build diffvbd/*.so *.egg-info .pytest_cache .ruff_cache .hypothesis $(BUILD)
	find diffvbd tests -name __pycache__ -type d -prune -exec rm -rf {} +

distclean: clean
	rm -rf $(VENV)
