# make train   train on push_plate from pixels (options: PRESET=..., RUN=..., ARGS=...)
# make test    run the tests
# make lint    style, types and spelling
# make docs    build the site in build/site
# make cuda    add the GPU builds of JAX and MJX-Warp to the environment
# make clean   remove the environment and caches; runs are kept
#
# Each makes .venv by itself, from the lock files, the first time.

SHELL := /bin/sh
VENV := .venv
BIN := $(VENV)/bin
PIP := $(BIN)/python -m pip --disable-pip-version-check
PRESET ?= push_plate
RUN ?=
ARGS ?=
PYTEST_ARGS ?=

.PHONY: train test lint docs cuda clean
.DELETE_ON_ERROR:

train: $(VENV)/.runtime
	$(BIN)/apnpql train $(PRESET) $(if $(RUN),--run "$(RUN)") $(ARGS)

test: $(VENV)/.dev
	$(BIN)/python -m pytest -n auto --dist loadfile --no-loadscope-reorder $(PYTEST_ARGS)

lint: $(VENV)/.dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/ty check --python $(VENV)
	$(BIN)/codespell

docs: $(VENV)/.docs
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict

cuda: $(VENV)/.runtime
	$(PIP) install --no-build-isolation --constraint requirements.lock -e '.[cuda]'

clean:
	if [ -e $(VENV)/.make ] || [ -e $(VENV)/.python ]; then rm -rf $(VENV); fi
	rm -rf .pytest_cache .ruff_cache .hypothesis build dist
	find apnpql_jax benchmarks docs experiments tests -name __pycache__ -type d -prune -exec rm -rf {} +

# Training needs only the first lock; what the tests add comes with the first test.
$(VENV)/.runtime: requirements.lock pyproject.toml | $(VENV)/.python
	$(PIP) install --quiet --no-deps --requirement requirements.lock
	$(PIP) install --quiet --no-deps --no-build-isolation --editable .
	@touch $@

$(VENV)/.dev: requirements-dev.lock $(VENV)/.runtime
	$(PIP) install --quiet --no-deps --requirement requirements-dev.lock
	@touch $@

# The site is made from the sources as text, so it needs nothing but its own lock.
$(VENV)/.docs: requirements-docs.lock | $(VENV)/.python
	$(PIP) install --quiet --no-deps --requirement requirements-docs.lock
	@touch $@

# The marker .make comes first: what an interrupted call has left is replaced, and nothing
# else. Python 3.11 comes first, because it is the version the locks were made with.
$(VENV)/.python:
	@if [ -e $(VENV) ] && [ ! -e $(VENV)/.make ]; then \
	  echo "$(VENV) was not made by make, or not finished; move it away or remove it" >&2; \
	  exit 1; \
	fi; \
	rm -rf $(VENV); \
	for python in $(PYTHON) python3.11 python3.12 python3.13 python3.14 python3; do \
	  if "$$python" -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null; then \
	    echo "making $(VENV) with $$python (several minutes the first time)"; \
	    mkdir -p $(VENV) && touch $(VENV)/.make && "$$python" -m venv $(VENV) && \
	      touch $@ && exit 0; \
	    rm -rf $(VENV); \
	    echo "$$python cannot make a virtual environment; install its venv module" >&2; \
	    exit 1; \
	  fi; \
	done; \
	echo "Python 3.11 or newer is needed; install it, or name it: make PYTHON=/path/to/python" >&2; \
	exit 1
