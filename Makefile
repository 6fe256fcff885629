# Two commands do everything on a fresh machine: `make demo` and `make test`.
PYTHON ?= python3
BIN := .venv/bin

.PHONY: demo test check lint types contracts generated lcm-types fuzz soak clean

demo: .venv/installed
	$(BIN)/rtc3d-gateway demo

test: .venv/installed
	tests/with-netns $(BIN)/pytest $(ARGS)

check: lint types contracts generated test

lint: .venv/installed
	$(BIN)/ruff format --check
	$(BIN)/ruff check

types: .venv/installed
	$(BIN)/mypy

contracts: .venv/installed
	$(BIN)/lint-imports

# The committed Python types are those that lcm-gen makes of the .lcm files today.
generated: .venv/installed
	rm -rf build/lcm_types && mkdir -p build/lcm_types
	$(BIN)/lcm-gen --python --ppath build/lcm_types lcm_types/rtc3d/*.lcm
	diff -r --exclude='*.lcm' --exclude=__pycache__ build/lcm_types lcm_types

# lcm-gen appends to an existing __init__.py, so the old files go first.
lcm-types: .venv/installed
	rm -f lcm_types/rtc3d/*.py
	$(BIN)/lcm-gen --python --ppath lcm_types lcm_types/rtc3d/*.lcm

.venv/installed: pyproject.toml
	$(PYTHON) -m venv .venv
	$(BIN)/pip install --quiet --upgrade 'pip>=25.1'
	$(BIN)/pip install --quiet --editable . --group dev
	touch $@

# Coverage-guided fuzzing, FUZZ_SECONDS for each target; not part of the check.
FUZZ_SECONDS ?= 60
FUZZ_TARGETS ?= packets frames connection commands parameters configuration messages

fuzz: .venv/installed
	$(BIN)/pip install --quiet atheris
	set -e; for target in $(FUZZ_TARGETS); do \
		echo "fuzzing $$target for $(FUZZ_SECONDS) s"; mkdir -p build/fuzz; \
		(cd build/fuzz && PYTHONPATH=../.. ../../$(BIN)/python ../../tests/fuzz/fuzz.py $$target corpus-$$target \
			-max_total_time=$(FUZZ_SECONDS) -print_final_stats=1 -verbosity=0); \
	done

# Random faults for SOAK_MINUTES, then a report; not part of the check.
SOAK_MINUTES ?= 30

soak: .venv/installed
	tests/with-netns $(BIN)/python -m tests.soak --minutes $(SOAK_MINUTES) --report docs/reliability.md

clean:
	rm -rf .venv build dist
