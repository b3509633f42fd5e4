# Everything a newcomer needs: `make demo`, `make test`. Only Python 3.11 or newer and make are expected.
PYTHON ?= $(shell command -v python3.11 || command -v python3)
BIN := .venv/bin
INSTALL := $(BIN)/python -m pip install --quiet --disable-pip-version-check --constraint constraints.txt

.PHONY: demo test lint types results agents clean

demo: .venv/core ## the baseline rows of the paper's Table 1, with three estimators, in runs/baselines
	$(BIN)/excite benchmark studies/baselines.toml --out runs/baselines --overwrite

test: lint types ## the whole test suite
	$(BIN)/python -m pytest -n 2 --dist loadscope

lint: .venv/dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

types: .venv/dev
	$(BIN)/basedpyright --pythonpath $(BIN)/python

results: .venv/core ## the committed results, afresh (minutes in studies/README.md)
	for study in baselines nls nls_quantised; do \
	  $(BIN)/excite benchmark studies/$$study.toml --out results/$$study --overwrite || exit 1; \
	done

agents: .venv/dev ## the trained agents of the studies, afresh (hours; goes on where it was interrupted)
	for study in table1; do \
	  $(BIN)/excite study run studies/$$study.toml --out runs/$$study || exit 1; \
	done

.venv/core: pyproject.toml constraints.txt
	$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11) and "Python 3.11 or newer is needed")'
	$(PYTHON) -m venv .venv
	$(INSTALL) --editable .
	touch $@

.venv/dev: .venv/core
	$(INSTALL) --editable '.[dev,ppo,dask]'
	touch $@

clean:
	rm -rf .venv
