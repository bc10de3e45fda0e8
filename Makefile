# Only python3 (3.11 or later) and make are presupposed; everything else goes into .venv.
PYTHON ?= python3
BIN := .venv/bin
READY := .venv/ready

.PHONY: demo test lint format screenshot reproduce lock clean

demo: $(READY)  ## both sites on this machine, with the dashboard, until Ctrl-C
	$(BIN)/farhand demo $(ARGS)

test: $(READY)  ## the whole test suite
	$(BIN)/python -m pytest $(ARGS)

lint: $(READY)  ## style, types, import directions
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports

format: $(READY)
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

screenshot: $(READY)  ## the dashboard's picture in the README
	$(BIN)/farhand demo --duration 24 --screenshot docs/dashboard.png

reproduce: $(READY)  ## the paper's figures and claims, into docs/reproduction
	$(BIN)/farhand reproduce all --out docs/reproduction

$(READY): requirements.lock pyproject.toml
	$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11) and "farhand needs Python 3.11 or later, this is " + sys.version.split()[0])'
	$(PYTHON) -m venv .venv
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --require-hashes -r requirements.lock
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-deps --no-build-isolation --editable .
	touch $(READY)

lock:  ## pin every dependency again (needs uv)
	uv pip compile --universal --generate-hashes --no-header --extra dev --upgrade pyproject.toml -o requirements.lock

clean:
	rm -rf .venv build *.egg-info .mypy_cache .ruff_cache .pytest_cache
