# The steps of `make check`, and the tests that `make test` (Makefile) leaves out.
.PHONY: test-slow test-install test-anywhere test-compiled \
    beside-tests bytecode lint types contracts generated workflows \
    mutants fuzz soak stops hiroz opensim

# What is slow by nature: attacks, outages, browsers, installing from source, systemd, the examples in other languages,
# and the commands in the documents.
SLOW_TESTS := $(addprefix tests/,systemd packaging hostile outages docs languages view bids)

test-slow: .venv/installed build/wheelhouse/complete ## attacks, browsers, systemd, other languages, documents
	MAKEFLAGS= SYSTEM_PYTHON=$(SYSTEM_PYTHON) exec $(BIN)/python tests/run.py $(AGAIN) --dist loadgroup \
	    --workers $$((2 * $$(nproc))) $(or $(ARGS),$(SLOW_TESTS))

# What is released: the package of `make deb`, an upgrade from that of the previous commit, lintian, and a second build;
# the wheels and the sdist on a Debian without a compiler; the container image; bills, licences; the site. It takes a
# quarter of an hour, and is not part of the check.
test-install: .venv/installed build/wheelhouse/complete build/compiled/complete $(RELEASE_TOOLS) ## what is released, built and installed
	$(BIN)/python -B -m tests.support.bare_debian
	MAKEFLAGS= exec $(BIN)/python tests/run.py --dist loadgroup $(or $(ARGS),tests/systemd tests/release tests/site tests/benchmarks)

# The tests of the compiled modules and of what uses them, run with the compiled modules instead of the sources.
# Tests marked `interpreted` replace what compiled code does not look up, or would wait 14 s because they cannot.
# Left out are the properties of configurations, of parameters and of VRPN, whose code is not compiled.
COMPILED_TESTS := tests/packaging/test_compiled.py tests/unit/runtime/test_failures.py $(wildcard tests/unit/outputs/test_*.py) \
    $(filter-out %/test_config_properties.py %_environment_properties.py %_parameters_properties.py %_vrpn_properties.py, \
        $(wildcard tests/property/test_*.py)) \
    $(addprefix tests/contract/test_,outputs.py back_pressure.py stalled_peers.py) \
    $(addprefix tests/unit/,messages outputs/zenoh outputs/lcm outputs/takes publish queries rtc3d session) \
    $(addprefix tests/unit/,takes/files benchmarks/test_own_cost.py client/test_recorder.py) tests/integration/test_streams.py tests/unit/daemon/test_gateway.py

test-compiled: build/compiled/complete ## the tests of the compiled modules
	MAKEFLAGS= $(COMPILED) RTC3D_COMPILED=1 exec $(BIN)/python tests/run.py $(AGAIN) --workers 3 -m 'not interpreted' $(or $(ARGS),$(COMPILED_TESTS))

# The tests in other surroundings: a machine that has just booted or has been up for 400 days, other time zones, locales,
# users, host names and Pythons, one core, random order. It needs root, and takes an hour; SURROUNDINGS="fresh user"
# selects some, and SLOW= leaves the slow tests out. A release needs it; it is not part of the check.
SURROUNDINGS ?=
SLOW ?= --slow

test-anywhere: .venv/installed ## all tests in other surroundings: users, uptimes, time zones, Pythons; as root
	$(BIN)/python -B -m tests.anywhere $(SLOW) $(SURROUNDINGS)

# One after the other, beside tests that wait.
beside-tests: types contracts generated docs workflows wheelhouse

# Write the bytecode of the tests: workers that start together would each compile all of them, in 10 s.
bytecode: .venv/installed
	-env --unset=PYTHONDONTWRITEBYTECODE $(BIN)/python -m pytest --collect-only -qq tests >/dev/null

lint: .venv/installed ## ruff
	$(BIN)/ruff format --check
	$(BIN)/ruff check

types: .venv/installed ## mypy
	$(BIN)/mypy

contracts: .venv/installed ## import-linter
	$(BIN)/lint-imports

# Check that the committed Python types equal what lcm-gen generates from the .lcm files.
generated: .venv/installed ## compare the Python types with the .lcm files
	rm -rf build/lcm_types && mkdir -p build/lcm_types
	$(BIN)/lcm-gen --python --ppath build/lcm_types lcm_types/rtc3d/*.lcm
	diff -r --exclude='*.lcm' --exclude=__pycache__ --exclude=vectors build/lcm_types lcm_types

# Check the workflows and the shell scripts. Building actionlint takes 10 s, once, and needs go; without it or without
# shellcheck, a message says so.
ACTIONLINT := github.com/rhysd/actionlint/cmd/actionlint@v1.7.7
SHELL_SCRIPTS := .ci/run config/certificates.sh release/image/build release/image/healthz tests/quick-cc $(wildcard release/deb/p??inst release/deb/p??rm)

workflows: build/bin/actionlint ## actionlint and shellcheck
	@if command -v shellcheck >/dev/null; then shellcheck --severity=warning $(SHELL_SCRIPTS); else echo 'shellcheck is missing (Debian: shellcheck)'; fi
	@if [ -x $< ]; then $<; fi

build/bin/actionlint:
	@if command -v go >/dev/null; then GOBIN='$(CURDIR)/build/bin' go install $(ACTIONLINT); \
	else echo 'The workflows are not checked: go is missing (Debian: golang-go)'; fi

# Mutation tests: about 250 changes of meaning, each of which some test should notice. PACKAGES="session publish"
# selects packages. Not part of the check.
PACKAGES ?=

mutants: .venv/installed ## mutation tests
	$(BIN)/python -m tests.mutants $(PACKAGES)

# Coverage-guided fuzzing, FUZZ_SECONDS for each target, and FUZZ_EXAMPLES new random examples and schedules for each
# property, of which `make test` tries 100; not part of the check.
FUZZ_SECONDS ?= 60
FUZZ_EXAMPLES ?= 2000
FUZZ_TESTS ?= $(shell grep --recursive --files-with-matches 'from hypothesis' tests/property tests/unit --include='test_*.py')
FUZZ_TARGETS ?= packets frames connection commands parameters configuration messages take

fuzz: .venv/installed ## coverage-guided fuzzing, and more examples of hypothesis
	$(BIN)/pip install --quiet atheris
	set -e; for target in $(FUZZ_TARGETS); do \
		echo "fuzzing $$target for $(FUZZ_SECONDS) s"; mkdir -p build/fuzz; \
		(cd build/fuzz && PYTHONPATH=../.. ../../$(BIN)/python ../../tests/fuzz/fuzz.py $$target corpus-$$target \
			-max_total_time=$(FUZZ_SECONDS) -print_final_stats=1 -verbosity=0); \
	done
	MAKEFLAGS= FUZZ_EXAMPLES=$(FUZZ_EXAMPLES) $(BIN)/python tests/run.py --hypothesis-profile=fuzz --timeout=0 $(FUZZ_TESTS)

# Random faults and attacks for SOAK_MINUTES, then a report; not part of the check.
SOAK_MINUTES ?= 30

soak: build/compiled/complete ## random faults and attacks for SOAK_MINUTES
	$(COMPILED) tests/with-netns $(BIN)/python -m tests.soak --minutes $(SOAK_MINUTES) --report docs/dev/reliability.md

# Stop a gateway under load STOPS times; every stop must end with status 0 within 2 s. Not part of the check.
STOPS ?= 500

stops: .venv/installed ## stop a gateway under load STOPS times
	tests/with-netns $(BIN)/python -m tests.stops --count $(STOPS)

# Receive what the output ros2 publishes with the Rust crate hiroz, another implementation of rmw_zenoh. It needs cargo,
# and six minutes for the first build. Not part of the check.
hiroz: .venv/installed ## receive the output ros2 in Rust
	cargo build --quiet --manifest-path tests/ros2_hiroz/Cargo.toml
	tests/with-netns $(BIN)/python -m tests.ros2_hiroz

# Read an export with OpenSim, which takes 280 MB and is not a dependency. Not part of the check.
opensim: .venv/installed ## read an export with OpenSim
	$(BIN)/pip install --quiet opensim
	$(BIN)/python -m tests.opensim
