# Two commands do everything on a fresh machine: `make demo` and `make test`.
PYTHON ?= python3
BIN := .venv/bin

# Where `make install` puts things. Units in /etc/systemd/system would be the administrator's, and could not be masked.
PREFIX := /opt/rtc3d-gateway
CONFIG := /etc/rtc3d-gateway
LIB := /usr/local/lib
UNITS := rtc3d-gateway.service rtc3d-gateway@.service

# What tests of installing use; sudo finds this one, and the service can reach it.
SYSTEM_PYTHON ?= /usr/bin/python3

# What a wheel is made of.
SOURCES := gateway lcm_types config pyproject.toml README.md LICENSE

.PHONY: demo test test-compiled check lint types contracts generated docs lcm-types fuzz soak mutants bench bench-quick zenohd \
    wheel compiled wheelhouse install uninstall clean

demo: .venv/installed
	$(BIN)/rtc3d-gateway demo

test: .venv/installed
	SYSTEM_PYTHON=$(SYSTEM_PYTHON) tests/with-netns $(BIN)/pytest $(ARGS)

# The tests of what is compiled, and of what stands on it, with the compiled modules in place of the sources.
# What rate.py waits cannot be shortened there, and takes 14 s; nor can bytes say another length than theirs.
COMPILED_TESTS := tests/packaging/test_compiled.py tests/contract tests/unit/rtc3d tests/unit/outputs tests/unit/queries \
    tests/integration/test_faults.py::test_several_faults_at_once \
    $(foreach name,clock components client_protocol fanout gateway intake message pacing packets rate streams, \
        $(wildcard tests/*/test_$(name)*.py)) \
    --deselect tests/integration/test_streams.py::test_late_frames_make_the_gateway_request_a_lower_rate_until_they_are_in_time \
    --deselect tests/unit/rtc3d/test_packets.py::test_a_packet_of_a_byte_less_can_be_encoded

test-compiled: build/compiled/complete
	$(COMPILED) RTC3D_COMPILED=1 tests/with-netns $(BIN)/pytest $(or $(ARGS),$(COMPILED_TESTS))

check: lint types contracts generated docs wheelhouse test test-compiled

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

# The site, in build/site; a link that leads nowhere ends it. (With --quiet, mkdocs would not see its own warnings.)
docs: .venv/installed
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict

# lcm-gen appends to an existing __init__.py, so the old files go first.
lcm-types: .venv/installed
	rm -f lcm_types/rtc3d/*.py
	$(BIN)/lcm-gen --python --ppath lcm_types lcm_types/rtc3d/*.lcm

# What is missing for compiling with a Python: the C compiler that it would call, its headers.
MISSING = import os, shutil, sysconfig; \
    compiler = (os.environ.get("CC") or sysconfig.get_config_var("CC")).split()[0]; \
    header = sysconfig.get_path("include") + "/Python.h"; \
    print(" and ".join([compiler] * (not shutil.which(compiler)) + [header] * (not os.path.exists(header))))

# $(call pip,PYTHON,WHAT TO DO[,EXTRAS]): build the gateway and do with it what pip is told, compiled if that can be.
# The compiler writes beside the sources, and what it wrote would be imported in place of them: so it has a copy.
# Modules compiled together call each other directly if other libraries cannot see them (visibility), and Python's own
# functions without a stub in between (no-plt): 3 % fewer instructions a frame.
define pip
@set -e; copy=$$(mktemp -d); trap 'rm -rf "$$copy"' EXIT; cp -R $(SOURCES) "$$copy"; \
missing=$$($(1) -c '$(MISSING)'); \
if [ -z "$$missing" ]; then export HATCH_BUILD_HOOK_ENABLE_MYPYC=1 CFLAGS="$$CFLAGS -fvisibility=hidden -fno-plt"; \
else echo "Plain Python, for want of $$missing (Debian: apt-get install gcc python3-dev):" \
    "the gateway works the same, with more CPU time for each frame."; fi; \
$(1) -m pip $(2) "$$copy$(3)"
endef

# For `pipx install dist/*.whl`.
wheel:
	$(call pip,$(PYTHON),wheel --quiet --no-deps --wheel-dir dist)

# The gateway compiled, to be tested and measured; programs run with $(COMPILED) find it before the sources.
COMPILED := PYTHONSAFEPATH=1 PYTHONPATH=$(CURDIR)/build/compiled

compiled: build/compiled/complete

build/compiled/complete: .venv/installed $(shell find $(SOURCES) ! -path '*__pycache__*')
	rm -rf build/compiled
	$(call pip,$(BIN)/python,install --quiet --no-deps --target build/compiled)
	touch $@

# As root. The service runs as a user that cannot enter homes, so its Python must not be in one.
install:
	@$(PYTHON) -c 'import sys; home = sys.base_prefix.startswith(("/home/", "/root/")); \
	    sys.exit(f"{sys.base_prefix} is in a home, where the service cannot read; give make PYTHON=/usr/bin/python3" if home else 0)'
	$(PYTHON) -m venv $(PREFIX)/venv
	$(call pip,$(PREFIX)/venv/bin/python,install --quiet --upgrade,[systemd])
	install -d $(LIB)/systemd/system $(LIB)/sysusers.d $(LIB)/tmpfiles.d /usr/local/bin
	for unit in $(UNITS); do sed 's|/opt/rtc3d-gateway|$(PREFIX)|' systemd/$$unit >$(LIB)/systemd/system/$$unit; done
	install -m 644 systemd/sysusers.conf $(LIB)/sysusers.d/rtc3d-gateway.conf
	install -m 644 systemd/tmpfiles.conf $(LIB)/tmpfiles.d/rtc3d-gateway.conf
	systemd-sysusers rtc3d-gateway.conf
	systemd-tmpfiles --create rtc3d-gateway.conf
	[ -e $(CONFIG)/gateway.yaml ] || install -m 644 config/gateway.yaml $(CONFIG)/gateway.yaml
	install -m 644 config/gateway.schema.json $(CONFIG)/gateway.schema.json
	ln -sfn $(PREFIX)/venv/bin/rtc3d-gateway /usr/local/bin/rtc3d-gateway
	[ ! -d /run/systemd/system ] || systemctl daemon-reload
	@echo 'Name your server in $(CONFIG)/gateway.yaml; then: systemctl enable --now rtc3d-gateway'

# As root. What stays: the configurations in $(CONFIG), the C3D files in /var/lib/rtc3d-gateway, and the user that
# they belong to.
uninstall:
	[ ! -d /run/systemd/system ] || systemctl stop rtc3d-gateway.service 'rtc3d-gateway@*.service'
	[ ! -d /run/systemd/system ] || systemctl disable $(UNITS)
	rm -f $(UNITS:%=$(LIB)/systemd/system/%) $(LIB)/sysusers.d/rtc3d-gateway.conf \
	    $(LIB)/tmpfiles.d/rtc3d-gateway.conf /usr/local/bin/rtc3d-gateway $(CONFIG)/gateway.schema.json
	rm -rf $(PREFIX)/venv
	-rmdir $(PREFIX)
	[ ! -d /run/systemd/system ] || systemctl daemon-reload

# All that installing downloads, for its tests: they have no network.
BUILD_REQUIRES = import tomllib; project = tomllib.load(open("pyproject.toml", "rb")); \
    hook = project["tool"]["hatch"]["build"]["targets"]["wheel"]["hooks"]["mypyc"]; \
    print(*project["build-system"]["requires"], *hook["dependencies"])

wheelhouse: build/wheelhouse/complete

build/wheelhouse/complete: pyproject.toml
	rm -rf build/wheelhouse build/wheelhouse-venv
	$(SYSTEM_PYTHON) -m venv build/wheelhouse-venv
	build/wheelhouse-venv/bin/pip wheel --quiet --wheel-dir build/wheelhouse pip '.[systemd]' \
	    $$(build/wheelhouse-venv/bin/python -c '$(BUILD_REQUIRES)')
	touch $@

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

soak: build/compiled/complete
	$(COMPILED) tests/with-netns $(BIN)/python -m tests.soak --minutes $(SOAK_MINUTES) --report docs/reliability.md

# Mutation tests: thousands of small changes to the code, each of which some test should notice; one to two hours for
# all packages. PACKAGES="rtc3d stream publish outputs" are all there are. A table is printed at the end, and the
# changes that no test noticed are in mutants/survivors.diff. Not part of the check.
PACKAGES ?=

mutants: .venv/installed
	$(BIN)/pip install --quiet --group mutants
	tests/with-netns $(BIN)/python -P tests/mutants.py $(PACKAGES)

# Measures against bare Zenoh and LCM, into benchmarks/results.json and docs/performance.md: half an hour, on a
# quiet machine. PARTS="ceiling loss" measures these only; bench-quick is rough, and leaves the document alone.
PARTS ?=

bench: .venv/bench build/compiled/complete zenohd
	$(COMPILED) tests/with-netns $(BIN)/python -m benchmarks $(PARTS)

bench-quick: .venv/bench build/compiled/complete
	$(COMPILED) tests/with-netns $(BIN)/python -m benchmarks --quick $(PARTS)

.venv/bench: .venv/installed
	$(BIN)/pip install --quiet --group bench
	touch $@

# The real router, of the version of eclipse-zenoh, for the benchmarks: five minutes, once. Without cargo they
# do with a Python session as the router, and say so.
zenohd: .venv/installed
	version=$$($(BIN)/python -c 'from importlib.metadata import version; print(version("eclipse-zenoh"))'); \
	cargo install zenohd --quiet --version $$version --locked --root build/zenohd \
	|| echo 'no zenohd: a Python session will be the router'

clean:
	rm -rf .venv build dist mutants
