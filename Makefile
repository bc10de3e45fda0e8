# Only python3 (3.11 or later) and make are presupposed; everything else goes into .venv.
PYTHON ?= python3
BIN := .venv/bin
READY := .venv/ready

.PHONY: demo test lint format screenshot reproduce bench fuzz faults soak lock clean

demo: $(READY)  ## both sites on this machine, with the dashboard, until Ctrl-C
	$(BIN)/farhand demo $(ARGS)

test: $(READY)  ## the whole test suite: on all cores, then what must have the machine to itself
	$(BIN)/python -m pytest -n auto --dist worksteal -m "not patient and not processes and not viewer" $(ARGS) || [ $$? = 5 ]
	$(BIN)/python -m pytest -n auto --dist worksteal -m patient $(ARGS) || [ $$? = 5 ]
	$(BIN)/python -m pytest -m "processes or viewer" $(ARGS) || [ $$? = 5 ]  # 5: no test is of this kind

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

bench: $(READY)  ## half an hour of figures, each beside its yardstick, into docs/performance.md
	$(BIN)/farhand bench --page docs/performance.md --json docs/performance.json $(ARGS)

fuzz: $(READY)  ## a million mutated packets, then a coverage-guided minute
	$(BIN)/python -m tests.fuzz.packets --count 1000000
	$(BIN)/python -m tests.fuzz.atheris_packet -- -max_total_time=60

faults: $(READY)  ## the tables of docs/safety.md: every fault 20 times on real processes
	$(BIN)/python -m tests.faults.measure $(ARGS)
	$(BIN)/python -m tests.faults.test_watchdogs --repeats 20

soak: $(READY)  ## both daemons under a random schedule of faults; ARGS="--minutes 60 --seed 2"
	$(BIN)/python -m tests.faults.soak $(ARGS)

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
