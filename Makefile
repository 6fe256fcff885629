# `make demo` and `make test` need no preparation: each creates .venv first.
PYTHON ?= python3
BIN := .venv/bin

# Where `make install` puts its files. Units in /etc/systemd/system belong to the administrator and cannot be masked, so
# they go to $(LIB)/systemd/system.
PREFIX := /opt/rtc3d-gateway
CONFIG := /etc/rtc3d-gateway
LIB := /usr/local/lib
MAN := /usr/local/share/man/man1
UNITS := rtc3d-gateway.service rtc3d-gateway@.service

# The Python for tests of the installation. It must be one that sudo finds and that the service can read.
SYSTEM_PYTHON ?= /usr/bin/python3

# What a wheel is built from.
SOURCES := gateway lcm_types config pyproject.toml README.md LICENSE

.PHONY: demo lock test test-slow test-compiled check lint types contracts generated docs site lcm-types examples samples \
    screenshots fuzz soak stops hiroz mutants bench bench-quick bench-sites bench-sites-quick zenohd wheel compiled wheelhouse install uninstall clone-url clean

demo: .venv/runtime
	$(BIN)/rtc3d-gateway demo

# Unit, property, contract and integration tests. Without MAKEFLAGS, a make that a test runs does not look for the job
# slots of this one.
test: .venv/installed
	MAKEFLAGS= exec $(BIN)/python tests/run.py $(ARGS)

# What is slow by nature: attacks, outages, browsers, installation, systemd, the examples in other languages, and the
# commands in the documents.
SLOW_TESTS := $(addprefix tests/,systemd packaging hostile outages docs languages benchmarks view site)

test-slow: .venv/installed build/wheelhouse/complete
	MAKEFLAGS= SYSTEM_PYTHON=$(SYSTEM_PYTHON) exec $(BIN)/python tests/run.py --dist loadgroup $(or $(ARGS),$(SLOW_TESTS))

# The tests of the compiled modules and of what uses them, run with the compiled modules instead of the sources.
# Tests marked `interpreted` replace what compiled code does not look up, or would wait 14 s because they cannot.
COMPILED_TESTS := tests/packaging/test_compiled.py tests/property tests/unit/logs/test_failures.py $(wildcard tests/unit/outputs/test_*.py) \
    $(addprefix tests/contract/test_,outputs.py back_pressure.py stalled_peers.py) \
    $(addprefix tests/unit/,messages outputs/zenoh outputs/lcm outputs/takes publish queries rtc3d stream) \
    $(addprefix tests/unit/,takes/files takes/test_recorder.py) tests/integration/test_streams.py tests/unit/service/test_gateway.py

test-compiled: build/compiled/complete
	MAKEFLAGS= $(COMPILED) RTC3D_COMPILED=1 exec $(BIN)/python tests/run.py -m 'not interpreted' $(or $(ARGS),$(COMPILED_TESTS))

# The tests use both cores, and wait often enough for the compiler and mypy to run beside them.
check: .venv/installed
	$(MAKE) --keep-going --output-sync=target --no-print-directory --jobs=3 lint contracts generated docs wheelhouse
	$(MAKE) --keep-going --no-print-directory --jobs=3 test compiled types
	$(MAKE) --no-print-directory test-slow
	$(MAKE) --no-print-directory test-compiled

lint: .venv/installed
	$(BIN)/ruff format --check
	$(BIN)/ruff check

types: .venv/installed
	$(BIN)/mypy

contracts: .venv/installed
	$(BIN)/lint-imports

# Check that the committed Python types equal what lcm-gen generates from the .lcm files.
generated: .venv/installed
	rm -rf build/lcm_types && mkdir -p build/lcm_types
	$(BIN)/lcm-gen --python --ppath build/lcm_types lcm_types/rtc3d/*.lcm
	diff -r --exclude='*.lcm' --exclude=__pycache__ --exclude=vectors build/lcm_types lcm_types

# Build the site in build/site; a broken link is an error. (With --quiet, --strict would not count mkdocs' warnings.)
docs: .venv/installed
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict

# Commit the site of this version to the branch gh-pages, beside those of other versions: /1.0/, to which /latest/ leads.
# `git push origin gh-pages` publishes it.
site: .venv/installed
	set -e; version=$$($(BIN)/python -c 'from gateway import __version__; print(__version__.rpartition(".")[0])'); \
	export PATH=$(abspath $(BIN)):$$PATH NO_MKDOCS_2_WARNING=1; \
	mike deploy --config-file mkdocs-versions.yml --update-aliases --alias-type redirect $$version latest; \
	mike set-default --config-file mkdocs-versions.yml latest

# lcm-gen appends to an existing __init__.py, so delete the old files first.
lcm-types: .venv/installed
	rm -f lcm_types/rtc3d/*.py
	$(BIN)/lcm-gen --python --ppath lcm_types lcm_types/rtc3d/*.lcm

# Build the programs in examples/ whose tools are installed, and say which were left out and why.
examples: .venv/installed
	$(MAKE) --no-print-directory -C examples PYTHON=$(CURDIR)/$(BIN)/python

# Record the sample take and the sample C3D file again.
samples: .venv/installed
	$(BIN)/python examples/make_samples.py

# Make the pictures of the live view in docs/ again, in Debian's Chromium. Look at them before you commit them.
screenshots: .venv/installed
	tests/with-netns unshare --uts sh -c 'echo mocap-pc >/proc/sys/kernel/hostname && exec $(BIN)/python -m tests.screenshots'

# Print what the compilation for a Python lacks: the C compiler that it would call, or its headers.
MISSING = import os, shutil, sysconfig; \
    compiler = (os.environ.get("CC") or sysconfig.get_config_var("CC")).split()[0]; \
    header = sysconfig.get_path("include") + "/Python.h"; \
    print(" and ".join([compiler] * (not shutil.which(compiler)) + [header] * (not os.path.exists(header))))

# $(call pip,PYTHON,PIP COMMAND[,EXTRAS]): run a pip command on the gateway, compiled if possible.
# mypyc writes its output beside the sources, and Python would import that output instead of the sources. It therefore
# compiles a copy. The flags save 3 % of the instructions per frame: with hidden visibility, compiled modules call each
# other directly, and with no-plt they call Python's own functions without a stub.
define pip
@set -e; copy=$$(mktemp -d); trap 'rm -rf "$$copy"' EXIT; cp -R $(SOURCES) "$$copy"; \
missing=$$($(1) -c '$(MISSING)'); \
if [ -z "$$missing" ]; then export HATCH_BUILD_HOOK_ENABLE_MYPYC=1 CFLAGS="$$CFLAGS -fvisibility=hidden -fno-plt"; \
else echo "Not compiled; missing: $$missing (Debian: apt-get install gcc python3-dev)." \
    "The gateway works the same but needs more CPU time per frame."; fi; \
$(1) -m pip $(2) "$$copy$(3)"
endef

# Build a wheel for `pipx install dist/*.whl`.
wheel:
	$(call pip,$(PYTHON),wheel --quiet --no-deps --wheel-dir dist)

# The compiled gateway, for tests and measurements. Programs run with $(COMPILED) import it instead of the sources.
COMPILED := PYTHONSAFEPATH=1 PYTHONPATH=$(CURDIR)/build/compiled

compiled: build/compiled/complete

build/compiled/complete: .venv/installed $(shell find $(SOURCES) ! -path '*__pycache__*')
	rm -rf build/compiled
	$(call pip,$(BIN)/python,install --quiet --no-deps --target build/compiled)
	touch $@

# Run as root. The service's user cannot read home directories, so its Python must not be in one.
install:
	@$(PYTHON) -c 'import sys; home = sys.base_prefix.startswith(("/home/", "/root/")); \
	    sys.exit(f"the service cannot read {sys.base_prefix}, which is in a home directory; run make with PYTHON=/usr/bin/python3" if home else 0)'
	$(PYTHON) -m venv $(PREFIX)/venv
	$(PREFIX)/venv/bin/pip install --quiet --require-hashes --requirement requirements.txt
	$(call pip,$(PREFIX)/venv/bin/python,install --quiet --upgrade --no-deps)
	install -d $(LIB)/systemd/system $(LIB)/sysusers.d $(LIB)/tmpfiles.d $(MAN) /usr/local/bin
	for unit in $(UNITS); do sed 's|/opt/rtc3d-gateway|$(PREFIX)|' systemd/$$unit >$(LIB)/systemd/system/$$unit; done
	install -m 644 systemd/sysusers.conf $(LIB)/sysusers.d/rtc3d-gateway.conf
	install -m 644 systemd/tmpfiles.conf $(LIB)/tmpfiles.d/rtc3d-gateway.conf
	systemd-sysusers rtc3d-gateway.conf
	systemd-tmpfiles --create rtc3d-gateway.conf
	[ -e $(CONFIG)/gateway.yaml ] || install -m 644 config/gateway.yaml $(CONFIG)/gateway.yaml
	install -m 644 config/gateway.schema.json $(CONFIG)/gateway.schema.json
	$(PREFIX)/venv/bin/python -P -m gateway.cli.man_page >$(MAN)/rtc3d-gateway.1
	chmod 644 $(MAN)/rtc3d-gateway.1
	ln -sfn $(PREFIX)/venv/bin/rtc3d-gateway /usr/local/bin/rtc3d-gateway
	[ ! -d /run/systemd/system ] || systemctl daemon-reload
	@echo 'Enter your server in $(CONFIG)/gateway.yaml; then: systemctl enable --now rtc3d-gateway'

# Run as root. This keeps the configurations in $(CONFIG), the C3D files in /var/lib/rtc3d-gateway, and the user that
# owns them.
uninstall:
	[ ! -d /run/systemd/system ] || systemctl stop rtc3d-gateway.service 'rtc3d-gateway@*.service'
	[ ! -d /run/systemd/system ] || systemctl disable $(UNITS)
	rm -f $(UNITS:%=$(LIB)/systemd/system/%) $(LIB)/sysusers.d/rtc3d-gateway.conf \
	    $(LIB)/tmpfiles.d/rtc3d-gateway.conf /usr/local/bin/rtc3d-gateway $(MAN)/rtc3d-gateway.1 \
	    $(CONFIG)/gateway.schema.json
	rm -rf $(PREFIX)/venv
	-rmdir $(PREFIX)
	[ ! -d /run/systemd/system ] || systemctl daemon-reload

# Download the packages that an installation needs: its tests have no network.
BUILD_REQUIRES = import tomllib; project = tomllib.load(open("pyproject.toml", "rb")); \
    hook = project["tool"]["hatch"]["build"]["targets"]["wheel"]["hooks"]["mypyc"]; \
    print(*project["build-system"]["requires"], *hook["dependencies"])

wheelhouse: build/wheelhouse/complete

build/wheelhouse/complete: pyproject.toml requirements.txt
	rm -rf build/wheelhouse build/wheelhouse-venv
	$(SYSTEM_PYTHON) -m venv build/wheelhouse-venv
	build/wheelhouse-venv/bin/pip download --quiet --dest build/wheelhouse --require-hashes --requirement requirements.txt
	build/wheelhouse-venv/bin/pip wheel --quiet --wheel-dir build/wheelhouse pip \
	    $$(build/wheelhouse-venv/bin/python -c '$(BUILD_REQUIRES)')
	touch $@

# $(call timed,WHAT,EXPECTED TIME,COMMANDS): say what is done and how long it takes, do it quietly, say how long it took.
define timed
@set -e; echo '$(1) (about $(2)) …'; start=$$(date +%s); $(3); echo "Done in $$(($$(date +%s) - start)) s."
endef

# What running needs, with the live view, in the versions of requirements-view.txt; .venv/installed adds the
# development tools.
.venv/runtime: pyproject.toml requirements-view.txt
	$(call timed,Installing the gateway into .venv,40 s,$(PYTHON) -m venv .venv; \
	    $(BIN)/pip install --quiet --require-hashes --requirement requirements-view.txt; \
	    $(BIN)/pip install --quiet --no-deps --editable .)
	@$(BIN)/python -c 'import lcm' || { echo 'LCM cannot be used here. Install GLib: apt-get install libglib2.0-0'; exit 1; }
	@touch $@

.venv/installed: .venv/runtime
	$(call timed,Installing the development tools into .venv,1 min,$(BIN)/pip install --quiet --upgrade 'pip>=25.1'; \
	    $(BIN)/pip install --quiet --editable . --group dev)
	@touch $@

# Renew the versions of all dependencies for every supported Python and platform: requirements-view.txt has those of all
# extras, and requirements.txt the same without the live view and Parquet, which a service does not need.
UV_COMPILE := build/lock-venv/bin/uv pip compile --quiet --universal --python-version 3.11 --upgrade --generate-hashes \
    --no-annotate --no-header --no-emit-index-url

lock:
	$(PYTHON) -m venv build/lock-venv
	build/lock-venv/bin/pip install --quiet uv
	$(UV_COMPILE) --all-extras --output-file requirements-view.txt pyproject.toml
	$(UV_COMPILE) --extra c3d --extra foxglove --extra lsl --extra systemd --constraint requirements-view.txt \
	    --output-file requirements.txt pyproject.toml

# Coverage-guided fuzzing, FUZZ_SECONDS for each target; not part of the check.
FUZZ_SECONDS ?= 60
FUZZ_TARGETS ?= packets frames connection commands parameters configuration messages take

fuzz: .venv/installed
	$(BIN)/pip install --quiet atheris
	set -e; for target in $(FUZZ_TARGETS); do \
		echo "fuzzing $$target for $(FUZZ_SECONDS) s"; mkdir -p build/fuzz; \
		(cd build/fuzz && PYTHONPATH=../.. ../../$(BIN)/python ../../tests/fuzz/fuzz.py $$target corpus-$$target \
			-max_total_time=$(FUZZ_SECONDS) -print_final_stats=1 -verbosity=0); \
	done

# Random faults and attacks for SOAK_MINUTES, then a report; not part of the check.
SOAK_MINUTES ?= 30

soak: build/compiled/complete
	$(COMPILED) tests/with-netns $(BIN)/python -m tests.soak --minutes $(SOAK_MINUTES) --report docs/reliability.md

# Stop a gateway under load STOPS times; every stop must end with status 0 within 2 s. Not part of the check.
STOPS ?= 500

stops: .venv/installed
	tests/with-netns $(BIN)/python -m tests.stops --count $(STOPS)

# Receive what the output ros2 publishes with the Rust crate hiroz, another implementation of rmw_zenoh. It needs cargo,
# and six minutes for the first build. Not part of the check.
hiroz: .venv/installed
	cargo build --quiet --manifest-path tests/ros2_hiroz/Cargo.toml
	tests/with-netns $(BIN)/python -m tests.ros2_hiroz

# Mutation tests: about 150 changes of meaning, each of which some test should notice. PACKAGES="stream publish"
# selects packages. Not part of the check.
PACKAGES ?=

mutants: .venv/installed
	$(BIN)/python -m tests.mutants $(PACKAGES)

# Compare the gateway with a bare relay to Zenoh and LCM, and write benchmarks/results.json and docs/performance.md.
# This takes half an hour and needs an idle machine. PARTS="ceiling loss" measures only these parts. bench-quick takes
# two minutes, gives rough figures, and does not change the document.
PARTS ?=

bench: .venv/bench build/compiled/complete zenohd
	$(COMPILED) tests/with-netns $(BIN)/python -m benchmarks $(PARTS)

bench-quick: .venv/bench build/compiled/complete
	$(COMPILED) tests/with-netns $(BIN)/python -m benchmarks --quick $(PARTS)

# Measure two sites with a router each, and the link between them, and write benchmarks/sites/results.json and
# docs/scale.md. This takes half an hour and needs an idle machine, ip, tc and nsenter (Debian: iproute2, util-linux).
# PARTS as above. bench-sites-quick takes three minutes and does not change the document.
SITES := $(COMPILED) tests/with-netns $(BIN)/python -m benchmarks.sites

bench-sites: .venv/bench build/compiled/complete zenohd build/sites/release/site-subscriber
	$(SITES) $(PARTS)

bench-sites-quick: .venv/installed build/compiled/complete build/sites/release/site-subscriber
	$(SITES) --quick $(PARTS)

# The subscribers of two sites. Without cargo, they run in Python, which a few dozen of them keep busy.
SUBSCRIBER := benchmarks/sites/subscriber

build/sites/release/site-subscriber: $(addprefix $(SUBSCRIBER)/,Cargo.toml Cargo.lock main.rs)
	cargo build --release --locked --quiet --manifest-path $(SUBSCRIBER)/Cargo.toml --target-dir build/sites \
	|| echo 'site-subscriber not built: the benchmarks use Python subscribers'

.venv/bench: .venv/installed
	$(BIN)/pip install --quiet --group bench
	touch $@

# Build the router for the benchmarks, in the version of eclipse-zenoh; this takes five minutes, once. Without cargo,
# the benchmarks use a Python session as the router and report that.
zenohd: .venv/installed
	version=$$($(BIN)/python -c 'from importlib.metadata import version; print(version("eclipse-zenoh"))'); \
	cargo install zenohd --quiet --version $$version --locked --root build/zenohd \
	|| echo 'zenohd not built: the benchmarks use a Python session as the router'

# Change the address of the repository in pyproject.toml and in the documents: make clone-url URL=https://…
URL ?=
OLD_URL = $(shell sed -n 's/^Repository = "\([^"]*\)".*/\1/p' pyproject.toml)

clone-url:
	@[ -n '$(URL)' ] || { echo 'Give the new address: make clone-url URL=https://…' >&2; exit 2; }
	sed -i 's|$(OLD_URL)|$(URL)|g' pyproject.toml README.md docs/tutorial.md docs/how-to/service.md

clean:
	rm -rf .venv build dist examples/build
