# `make demo` and `make test` need no preparation: each creates .venv first.
PYTHON ?= python3
BIN := .venv/bin

# Where `make install` puts its files. Units in /etc/systemd/system belong to the administrator and cannot be masked, so
# they go to $(USR)/lib/systemd/system. The Debian package has its files in USR=/usr, below DESTDIR.
PREFIX := /opt/rtc3d-gateway
CONFIG := /etc/rtc3d-gateway
USR := /usr/local
DESTDIR :=
MAN_PAGE := $(USR)/share/man/man1/rtc3d-gateway.1
BASH_COMPLETION := $(USR)/share/bash-completion/completions/rtc3d-gateway
FISH_COMPLETION := $(USR)/share/fish/vendor_completions.d/rtc3d-gateway.fish
UNITS := rtc3d-gateway.service rtc3d-gateway@.service

# The Python for tests of the installation. It must be one that sudo finds and that the service can read.
SYSTEM_PYTHON ?= /usr/bin/python3

# The tools of a release, in a venv of their own: they must not change the versions that the tests use.
RELEASE_TOOLS := build/release-venv/complete
RELEASE_PYTHON := build/release-venv/bin/python

# What the compiled modules are built from.
SOURCES := gateway lcm_types config release pyproject.toml README.md LICENSE

.PHONY: demo lock test test-slow test-install test-anywhere test-compiled check beside-tests bytecode lint types contracts generated messages docs site lcm-types examples \
    samples screenshots fuzz soak stops hiroz opensim mutants bench bench-quick bench-tests bench-sites bench-sites-quick \
    native-peers zenohd release \
    check-sums wheels reproducible deb deb-lock image workflows wheel compiled wheelhouse install install-program install-files uninstall \
    clone-url clean

demo: .venv/runtime
	$(BIN)/rtc3d-gateway demo

# In CI, tests that failed are run again, alone (tests/run.py).
AGAIN :=

# Unit, property, contract and integration tests. Without MAKEFLAGS, a make that a test runs does not look for the job
# slots of this one.
test: .venv/installed
	MAKEFLAGS= exec $(BIN)/python tests/run.py $(AGAIN) $(ARGS)

# What is slow by nature: attacks, outages, browsers, installing from source, systemd, the examples in other languages,
# and the commands in the documents.
SLOW_TESTS := $(addprefix tests/,systemd packaging hostile outages docs languages view bids)

test-slow: .venv/installed build/wheelhouse/complete
	MAKEFLAGS= SYSTEM_PYTHON=$(SYSTEM_PYTHON) exec $(BIN)/python tests/run.py $(AGAIN) --dist loadgroup \
	    --workers $$((2 * $$(nproc))) $(or $(ARGS),$(SLOW_TESTS))

# What is released: the package of `make deb`, an upgrade from that of the previous commit, lintian, and a second build;
# the wheels and the sdist on a Debian without a compiler; the container image; bills, licences; the site. It takes a
# quarter of an hour, and is not part of the check.
test-install: .venv/installed build/wheelhouse/complete build/compiled/complete $(RELEASE_TOOLS)
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

test-compiled: build/compiled/complete
	MAKEFLAGS= $(COMPILED) RTC3D_COMPILED=1 exec $(BIN)/python tests/run.py $(AGAIN) --workers 3 -m 'not interpreted' $(or $(ARGS),$(COMPILED_TESTS))

# The tests in other surroundings: a machine that has just booted or has been up for 400 days, other time zones, locales,
# users, host names and Pythons, one core, random order. It needs root, and takes an hour; SURROUNDINGS="fresh user"
# selects some, and SLOW= leaves the slow tests out. A release needs it; it is not part of the check.
SURROUNDINGS ?=
SLOW ?= --slow

test-anywhere: .venv/installed
	$(BIN)/python -B -m tests.anywhere $(SLOW) $(SURROUNDINGS)

# What to run before each commit. What needs one core runs beside tests that wait. After changes to compiled modules, run
# `make test-compiled`, too, as CI does.
check: .venv/installed
	$(MAKE) --keep-going --no-print-directory --jobs=2 lint bytecode
	$(MAKE) --keep-going --no-print-directory --jobs=2 test beside-tests
	$(MAKE) --no-print-directory test-slow

# One after the other, beside tests that wait.
beside-tests: types contracts generated docs workflows wheelhouse

# Write the bytecode of the tests: workers that start together would each compile all of them, in 10 s.
bytecode: .venv/installed
	-env --unset=PYTHONDONTWRITEBYTECODE $(BIN)/python -m pytest --collect-only -qq tests >/dev/null

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

# Write the messages of level WARNING and above from the source code into the tables of docs/operations.md. A changed
# sentence keeps its advice; messages without advice are named. `make test` checks that the page is up to date.
messages: .venv/installed
	$(BIN)/python -m tests.support.operations_page

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
	$(MAKE) --no-print-directory -C examples PYTHON='$(CURDIR)/$(BIN)/python'

# Record the sample take and the sample C3D file again.
samples: .venv/installed
	$(BIN)/python examples/make_samples.py

# Make the pictures of the live view in docs/ again, in Debian's Chromium. Look at them before you commit them.
screenshots: .venv/installed
	tests/with-netns unshare --uts sh -c 'echo mocap-pc >/proc/sys/kernel/hostname && exec $(BIN)/python -m tests.screenshots'

# Build a wheel for `pipx install dist/*.whl`, compiled for $(PYTHON) if possible.
DIST := dist

wheel:
	@$(PYTHON) -B -m release.build --dist $(DIST) wheel

# Everything that a release publishes, in dist/: for each file a bill of materials, the licences, and the check sums.
# A further kind of file is a further target in ARTEFACTS. It puts its files, with a bill of its own, into dist/.
ARTEFACTS := wheels deb image
RELEASE := $(RELEASE_PYTHON) -B -m release

release: $(RELEASE_TOOLS) build/release-packages/complete
	@[ -z "$$(git status --porcelain)" ] || { echo 'A release is built from a commit: commit your changes first.' >&2; exit 1; }
	rm -rf dist && mkdir dist
	$(RELEASE).audit requirements-view.txt
	$(RELEASE).licences build/release-packages/bin/python dist/THIRD_PARTY.txt
	$(MAKE) --no-print-directory $(ARTEFACTS)
	$(MAKE) --no-print-directory check-sums
	@echo "Built in dist/: $$(ls dist | wc -l) files."

# The check sums of all files in dist/, also of those that were built on other machines.
check-sums:
	mkdir -p build; rm -f dist/SHA256SUMS
	cd dist && LC_ALL=C sha256sum * >../build/SHA256SUMS && mv ../build/SHA256SUMS .

# The sdist, a wheel for any Python, and a compiled wheel for each Python that this machine has.
wheels: $(RELEASE_TOOLS) build/release-packages/complete
	$(RELEASE).wheels
	$(RELEASE).sbom build/release-packages/bin/python dist/rtc3d_gateway-*.tar.gz dist/rtc3d_gateway-*.whl

# Build a release twice, in different surroundings, and compare the check sums.
reproducible:
	$(PYTHON) -B -m release.reproducible

# The compiled gateway, for tests and measurements. Programs run with $(COMPILED) import it instead of the sources.
COMPILED := PYTHONSAFEPATH=1 PYTHONPATH='$(CURDIR)/build/compiled'

compiled: build/compiled/complete

build/compiled/complete: .venv/installed $(shell find $(SOURCES) -type f ! -path '*__pycache__*')
	rm -rf build/compiled
	$(MAKE) --no-print-directory wheel PYTHON=$(BIN)/python DIST=build/compiled/wheel
	$(BIN)/pip install --quiet --no-deps --target build/compiled build/compiled/wheel/*.whl
	touch $@

# Run as root. The service's user cannot read home directories, so its Python must not be in one; and it must be able to
# read what root installs, whatever root's umask is.
install:
	@[ ! -e /usr/lib/systemd/system/rtc3d-gateway.service ] || { \
	    echo 'The Debian package is installed, with its files in the same place: apt remove rtc3d-gateway' >&2; exit 1; }
	@$(PYTHON) -c 'import sys; home = sys.base_prefix.startswith(("/home/", "/root/")); \
	    sys.exit(f"the service cannot read {sys.base_prefix}, which is in a home directory; run make with PYTHON=/usr/bin/python3" if home else 0)'
	umask 022; $(MAKE) --no-print-directory install-program
	umask 022; $(MAKE) --no-print-directory install-files PYTHON=$(PREFIX)/venv/bin/python
	systemd-sysusers rtc3d-gateway.conf
	systemd-tmpfiles --create rtc3d-gateway.conf
	[ ! -d /run/systemd/system ] || systemctl daemon-reload
	@echo 'Enter your server in $(CONFIG)/gateway.yaml; then: systemctl enable --now rtc3d-gateway'

install-program:
	$(PYTHON) -m venv $(PREFIX)/venv
	$(PREFIX)/venv/bin/pip install --quiet --require-hashes --requirement requirements.txt
	@set -e; dist=$$(mktemp -d); trap 'rm -rf "$$dist"' EXIT; $(PYTHON) -B -m release.build --dist "$$dist" wheel; \
	    $(PREFIX)/venv/bin/pip install --quiet --force-reinstall --no-deps "$$dist"/*.whl

# What an installation from source and the Debian package have in common, apart from the program itself. PYTHON must
# have the gateway.
install-files:
	install -d $(addprefix $(DESTDIR)$(USR)/,bin lib/systemd/system lib/sysusers.d lib/tmpfiles.d)
	install -d $(DESTDIR)$(CONFIG) $(dir $(addprefix $(DESTDIR),$(MAN_PAGE) $(BASH_COMPLETION) $(FISH_COMPLETION)))
	for unit in $(UNITS); do \
	    sed 's|/opt/rtc3d-gateway|$(PREFIX)|' systemd/$$unit >$(DESTDIR)$(USR)/lib/systemd/system/$$unit; done
	install -m 644 systemd/sysusers.conf $(DESTDIR)$(USR)/lib/sysusers.d/rtc3d-gateway.conf
	install -m 644 systemd/tmpfiles.conf $(DESTDIR)$(USR)/lib/tmpfiles.d/rtc3d-gateway.conf
	[ -e $(DESTDIR)$(CONFIG)/gateway.yaml ] || install -m 644 config/gateway.yaml $(DESTDIR)$(CONFIG)/gateway.yaml
	install -m 644 config/gateway.schema.json $(DESTDIR)$(CONFIG)/gateway.schema.json
	$(PYTHON) -P -m gateway.tools.cli.man_page >$(DESTDIR)$(MAN_PAGE)
	_RTC3D_GATEWAY_COMPLETE=source_bash $(PYTHON) -P -m gateway >$(DESTDIR)$(BASH_COMPLETION)
	_RTC3D_GATEWAY_COMPLETE=source_fish $(PYTHON) -P -m gateway >$(DESTDIR)$(FISH_COMPLETION)
	ln -sfn $(PREFIX)/venv/bin/rtc3d-gateway $(DESTDIR)$(USR)/bin/rtc3d-gateway

# Run as root. This keeps the configurations in $(CONFIG), the C3D files in /var/lib/rtc3d-gateway, and the user that
# owns them.
uninstall:
	[ ! -d /run/systemd/system ] || systemctl stop rtc3d-gateway.service 'rtc3d-gateway@*.service'
	[ ! -d /run/systemd/system ] || systemctl disable $(UNITS)
	rm -f $(UNITS:%=$(USR)/lib/systemd/system/%) $(USR)/lib/sysusers.d/rtc3d-gateway.conf \
	    $(USR)/lib/tmpfiles.d/rtc3d-gateway.conf $(USR)/bin/rtc3d-gateway $(MAN_PAGE) $(BASH_COMPLETION) \
	    $(FISH_COMPLETION) $(CONFIG)/gateway.schema.json
	rm -rf $(PREFIX)/venv
	-rmdir $(PREFIX)
	[ ! -d /run/systemd/system ] || systemctl daemon-reload

# Build the Debian package in dist/. It has the Python of Debian 12, and needs that of the machine to be the same.
deb: build/wheelhouse/complete $(RELEASE_TOOLS) build/release-packages/complete
	rm -rf build/deb/wheel
	build/wheelhouse-venv/bin/python -B -m release.build --dist build/deb/wheel compiled
	build/wheelhouse-venv/bin/python -B -m release.deb.build build/deb/wheel/*.whl build/wheelhouse
	$(RELEASE).sbom build/release-packages/bin/python dist/rtc3d-gateway_*.deb

# Renew the versions of the packages of Debian that the Debian package contains.
DEB_LOCK := release/deb/packages.txt

deb-lock:
	apt-get update
	$(PYTHON) -B -m release.deb.packages --newest >build/packages.txt && mv build/packages.txt $(DEB_LOCK)

# Build the container image from the Debian package, in dist/ as an OCI archive; it needs podman, and the registry of the base.
# The archive is the same for the same package and base. IMAGE_OPTIONS=--build-arg=BASE=… takes another base.
IMAGE_OPTIONS ?=
VERSION = $(shell sed -n 's/^__version__.*"\(.*\)"/\1/p' gateway/__init__.py)
OCI = dist/rtc3d-gateway_$(VERSION)_amd64.oci.tar

image: deb
	rm -rf build/image $(OCI)
	set -e; export SOURCE_DATE_EPOCH=$$(git log -1 --format=%ct); \
	    release/image/build dist/rtc3d-gateway_$(VERSION)_amd64.deb $(IMAGE_OPTIONS); \
	    podman save --quiet --format oci-dir --output build/image rtc3d-gateway:$(VERSION); \
	    tar --create --file build/image.tar --sort=name --mtime=@$$SOURCE_DATE_EPOCH --owner=0 --group=0 --numeric-owner \
	        --mode=u=rwX,go=rX --directory build/image blobs index.json oci-layout; \
	    mv build/image.tar $(OCI)
	$(RELEASE).sbom build/release-packages/bin/python $(OCI)

# Check the workflows and the shell scripts. Building actionlint takes 10 s, once, and needs go; without it or without
# shellcheck, a message says so.
ACTIONLINT := github.com/rhysd/actionlint/cmd/actionlint@v1.7.7
SHELL_SCRIPTS := .ci/run config/certificates.sh release/image/build release/image/healthz tests/quick-cc $(wildcard release/deb/p??inst release/deb/p??rm)

workflows: build/bin/actionlint
	@if command -v shellcheck >/dev/null; then shellcheck --severity=warning $(SHELL_SCRIPTS); else echo 'shellcheck is missing (Debian: shellcheck)'; fi
	@if [ -x $< ]; then $<; fi

build/bin/actionlint:
	@if command -v go >/dev/null; then GOBIN='$(CURDIR)/build/bin' go install $(ACTIONLINT); \
	else echo 'The workflows are not checked: go is missing (Debian: golang-go)'; fi

# Download the packages that an installation needs: its tests have no network.
wheelhouse: build/wheelhouse/complete

build/wheelhouse/complete: pyproject.toml requirements-view.txt release/build-requirements.txt
	rm -rf build/wheelhouse build/wheelhouse-venv
	$(SYSTEM_PYTHON) -m venv build/wheelhouse-venv
	set -e; for file in requirements-view.txt release/build-requirements.txt; do \
	    build/wheelhouse-venv/bin/pip download --quiet --dest build/wheelhouse --require-hashes --requirement $$file; done
	build/wheelhouse-venv/bin/pip download --quiet --dest build/wheelhouse pip
	touch $@

# $(call timed,WHAT,EXPECTED TIME,COMMANDS): say what is done and how long it takes, do it quietly, say how long it took.
define timed
@set -e; echo '$(1) (about $(2)) …'; start=$$(date +%s); $(3); echo "Done in $$(($$(date +%s) - start)) s."
endef

$(RELEASE_TOOLS): release/tool-requirements.txt
	$(call timed,Installing the tools of a release into build/release-venv,15 s,rm -rf build/release-venv; \
	    $(PYTHON) -m venv build/release-venv; \
	    build/release-venv/bin/pip install --quiet --require-hashes --requirement release/tool-requirements.txt)
	@touch $@

# The packages that a wheel installs with all its extras.
build/release-packages/complete: requirements-view.txt $(RELEASE_TOOLS)
	$(call timed,Installing the packages of a release into build/release-packages,30 s,rm -rf $(@D); \
	    $(PYTHON) -m venv --without-pip $(@D); build/release-venv/bin/pip --python $(@D)/bin/python install --quiet \
	    --require-hashes --requirement requirements-view.txt)
	@touch $@

# Python 3.11 cannot start with LC_ALL=C if a path has letters that ASCII lacks. So the paths of the sources are relative.
define install_sources
$(BIN)/pip install --quiet --editable . $(1); \
    for packages in .venv/lib/python3.*/site-packages; do \
        printf '../../../..\n../../../../lcm_types\n' >$$packages/_rtc3d_gateway.pth; done
endef

# What running needs, with the live view, in the versions of requirements-view.txt; .venv/installed adds the
# development tools.
.venv/runtime: pyproject.toml requirements-view.txt
	$(call timed,Installing the gateway into .venv,40 s,$(PYTHON) -m venv .venv; \
	    $(BIN)/pip install --quiet --require-hashes --requirement requirements-view.txt; \
	    $(call install_sources,--no-deps))
	@$(BIN)/python -c 'import lcm' || { echo 'LCM cannot be used here. Install GLib: apt-get install libglib2.0-0'; exit 1; }
	@touch $@

.venv/installed: .venv/runtime
	$(call timed,Installing the development tools into .venv,1 min,$(BIN)/pip install --quiet --upgrade 'pip>=25.1'; \
	    $(call install_sources,--group dev))
	@touch $@

# Renew the versions of all dependencies for every supported Python and platform: requirements-view.txt has those of all
# extras, and requirements.txt the same without the live view and Parquet, which a service does not need.
UV_COMPILE := build/lock-venv/bin/uv pip compile --quiet --universal --python-version 3.11 --upgrade --generate-hashes \
    --no-annotate --no-header --no-emit-index-url

# What pyproject.toml requires for a build.
BUILD_REQUIRES = import tomllib; project = tomllib.load(open("pyproject.toml", "rb")); \
    hook = project["tool"]["hatch"]["build"]["targets"]["wheel"]["hooks"]["mypyc"]; \
    print(*project["build-system"]["requires"], *hook["dependencies"], sep="\n")

lock:
	$(PYTHON) -m venv build/lock-venv
	build/lock-venv/bin/pip install --quiet uv
	$(UV_COMPILE) --all-extras --output-file requirements-view.txt pyproject.toml
	$(UV_COMPILE) --extra c3d --extra foxglove --extra lsl --extra systemd --constraint requirements-view.txt \
	    --output-file requirements.txt pyproject.toml
	build/lock-venv/bin/python -c '$(BUILD_REQUIRES)' | $(UV_COMPILE) --output-file release/build-requirements.txt -
	$(UV_COMPILE) --group release --constraint release/build-requirements.txt --output-file release/tool-requirements.txt

# Coverage-guided fuzzing, FUZZ_SECONDS for each target, and FUZZ_EXAMPLES new random examples and schedules for each
# property, of which `make test` tries 100; not part of the check.
FUZZ_SECONDS ?= 60
FUZZ_EXAMPLES ?= 2000
FUZZ_TESTS ?= $(shell grep --recursive --files-with-matches 'from hypothesis' tests/property tests/unit --include='test_*.py')
FUZZ_TARGETS ?= packets frames connection commands parameters configuration messages take

fuzz: .venv/installed
	$(BIN)/pip install --quiet atheris
	set -e; for target in $(FUZZ_TARGETS); do \
		echo "fuzzing $$target for $(FUZZ_SECONDS) s"; mkdir -p build/fuzz; \
		(cd build/fuzz && PYTHONPATH=../.. ../../$(BIN)/python ../../tests/fuzz/fuzz.py $$target corpus-$$target \
			-max_total_time=$(FUZZ_SECONDS) -print_final_stats=1 -verbosity=0); \
	done
	MAKEFLAGS= FUZZ_EXAMPLES=$(FUZZ_EXAMPLES) $(BIN)/python tests/run.py --hypothesis-profile=fuzz --timeout=0 $(FUZZ_TESTS)

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

# Read an export with OpenSim, which takes 280 MB and is not a dependency. Not part of the check.
opensim: .venv/installed
	$(BIN)/pip install --quiet opensim
	$(BIN)/python -m tests.opensim

# Mutation tests: about 200 changes of meaning, each of which some test should notice. PACKAGES="session publish"
# selects packages. Not part of the check.
PACKAGES ?=

mutants: .venv/installed
	$(BIN)/python -m tests.mutants $(PACKAGES)

# Check that the gateway and the relay do the same work in the benchmarks, and that those with two sites count exactly.
bench-tests: .venv/installed
	MAKEFLAGS= $(BIN)/python tests/run.py tests/benchmarks

# Compare the gateway with a bare relay to Zenoh and LCM, and write benchmarks/results.json and docs/performance.md.
# This takes half an hour and needs an idle machine. PARTS="ceiling loss" measures only these parts. bench-quick takes
# two minutes, gives rough figures, and does not change the document.
PARTS ?=

bench: .venv/bench build/compiled/complete zenohd native-peers bench-tests
	$(COMPILED) tests/with-netns $(BIN)/python -m benchmarks $(PARTS)

bench-quick: .venv/bench build/compiled/complete native-peers bench-tests
	$(COMPILED) tests/with-netns $(BIN)/python -m benchmarks --quick $(PARTS)

# Measure two sites with a router each, and the link between them, and write benchmarks/sites/results.json and
# docs/scale.md. This takes half an hour and needs an idle machine, ip, tc and nsenter (Debian: iproute2, util-linux).
# PARTS as above. bench-sites-quick takes three minutes and does not change the document.
SITES := $(COMPILED) tests/with-netns $(BIN)/python -m benchmarks.sites

bench-sites: .venv/bench build/compiled/complete zenohd bench-tests native-peers
	$(SITES) $(PARTS)

bench-sites-quick: .venv/installed build/compiled/complete native-peers
	$(SITES) --quick $(PARTS)

# Programs without Python: the subscribers of two sites, and the bare relays. Without cargo, the subscribers run in
# Python, which a few dozen of them keep busy; without the relays, the benchmarks do not compare with them.
NATIVE := benchmarks/native

native-peers: build/native/release/site-subscriber build/native/lcm-relay

build/native/release/site-subscriber: $(addprefix $(NATIVE)/,Cargo.toml Cargo.lock site_subscriber.rs zenoh_relay.rs)
	cargo build --release --locked --quiet --manifest-path $(NATIVE)/Cargo.toml --target-dir build/native \
	|| echo 'site-subscriber and zenoh-relay not built: they need cargo'

build/native/lcm-relay: $(NATIVE)/lcm_relay.c
	mkdir -p $(@D)
	$(CC) -O2 -Wall -Wextra -o $@ $< -llcm \
	|| echo 'lcm-relay not built: it needs a C compiler and liblcm (Debian: liblcm-dev)'

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
