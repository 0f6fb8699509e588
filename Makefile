# `make setup` needs Python 3.10+ and make; no root. What Debian splits off or lacks (pip, LLVM) is fetched with apt-get
# and unpacked inside $(VENV).
VENV   ?= .venv
PYTHON ?= python3
# A smaller CPU-only torch does as well: make setup TORCH=<wheel or URL>
TORCH  ?= torch==2.13.0
SCENE  ?= scenes/pot2.xml
ARGS   ?=

BIN = $(VENV)/$(if $(filter Windows_NT,$(OS)),Scripts,bin)
PIP = $(BIN)/pip$(if $(filter Windows_NT,$(OS)),.exe)
RUN = $(BIN)/python -m
NPM_CI = cd mi_ring/output/viewer && npm ci --ignore-scripts --no-audit --no-fund

.PHONY: help setup fit test tools viewer lint docs clean

help:
	@echo 'make setup                   create $(VENV) with everything in it (the targets below do it when needed)'
	@echo 'make fit [SCENE=...] [ARGS=] fit $(SCENE); ARGS=--resume goes on after an interrupt'
	@echo 'make test [ARGS=...]         run pytest; ARGS="-m \"not slow\"" leaves out packaging, notebooks, sphinx, browser'
	@echo 'make tools                   install what some tests need: Chromium (as root), the validator of glTF (with npm)'
	@echo 'make viewer                  bundle the viewer of the report anew (needs Node.js)'
	@echo 'make lint                    run ruff and mypy'
	@echo 'make docs                    build the documentation: build/docs/index.html'
	@echo 'make clean                   remove caches; $(VENV) stays'

setup: $(VENV)/.setup-done

$(VENV)/.setup-done: pyproject.toml Makefile mi_ring/system/llvm.py | $(PIP)
	$(BIN)/python -I mi_ring/system/llvm.py
	$(RUN) pip install $(TORCH)
	$(RUN) pip install -e '.[test]'
	@touch $@
	@echo 'Installed. Now: source $(BIN)/activate; mi-ring doctor'

# Debian and Ubuntu keep ensurepip in the package python3-venv. Without it, the wheel in python3-pip-whl is pip enough to
# install pip; it looks for certificates where a slim container has none, so give it those it came with.
$(PIP):
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 10))' \
	  || { echo 'make setup: Python 3.10 or newer is needed, for example PYTHON=python3.12' >&2; exit 1; }
	@if $(PYTHON) -c 'import ensurepip' 2>/dev/null; then $(PYTHON) -m venv $(VENV); else set -e; \
	  $(PYTHON) -m venv --without-pip $(VENV); \
	  deb=$(VENV)/pip-deb; wheels=/usr/share/python-wheels; certificates=/etc/ssl/certs/ca-certificates.crt; \
	  ls $$wheels/pip-*.whl >/dev/null 2>&1 || { $(PYTHON) -I mi_ring/system/llvm.py $$deb python3-pip-whl; wheels=$$deb$$wheels; }; \
	  test -e $$certificates || { certificates=$$deb/certificates; cat $$deb/usr/share/ca-certificates/*/*.crt >$$certificates; }; \
	  wheel=$$(ls $$wheels/pip-*.whl); \
	  PIP_CERT=$${PIP_CERT:-$$certificates} $(BIN)/python $$wheel/pip install --upgrade pip; \
	  rm -rf $$deb; fi

fit: setup
	$(RUN) mi_ring.fit "$(SCENE)" $(ARGS)

test: setup
	$(RUN) pytest -n auto --maxprocesses 4 --dist loadgroup $(ARGS)

# Without these the tests that need them are skipped.
tools:
	@if command -v chromium || command -v google-chrome; then :; \
	elif test "$$(id -u)" = 0; then apt-get update -qq && apt-get install -qq -y --no-install-recommends chromium \
	  || echo 'make tools: Chromium could not be installed' >&2; \
	else echo 'make tools: found no Chromium, and only root can install it (apt-get install chromium)' >&2; fi
	@if ! command -v npm; then echo 'make tools: found no npm; Node.js brings it' >&2; \
	elif ! ($(NPM_CI)); then echo 'make tools: npm could not fetch the validator of glTF' >&2; fi

# three.js and mi_ring/output/viewer/viewer.js in one file, which is part of the repository.
viewer:
	$(NPM_CI) && npm run build

lint: setup
	$(RUN) ruff check .
	$(RUN) mypy

docs: setup
	$(RUN) sphinx -W --keep-going -q docs build/docs
	@echo build/docs/index.html

clean:
	rm -rf .pytest_cache .ruff_cache build *.egg-info mi_ring/output/viewer/node_modules
	find . -path ./$(VENV) -prune -o -name __pycache__ -type d -exec rm -rf {} +
