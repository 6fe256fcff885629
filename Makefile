# `make demo` and `make test` need no preparation: each creates .venv first. `make help` lists what else there is.
PYTHON ?= python3
BIN := .venv/bin

# The Python for tests of the installation. It must be one that sudo finds and that the service can read.
SYSTEM_PYTHON ?= /usr/bin/python3

.PHONY: demo test check install docs release examples samples lcm-types clean help

demo: .venv/runtime ## see the gateway at work for 10 s
	$(BIN)/rtc3d-gateway demo

# In CI, tests that failed are run again, alone (tests/run.py).
AGAIN :=

# Unit, property, contract and integration tests. Without MAKEFLAGS, a make that a test runs does not look for the job
# slots of this one.
test: .venv/installed ## unit, property, contract and integration tests; ARGS=tests/unit/session selects some
	MAKEFLAGS= exec $(BIN)/python tests/run.py $(AGAIN) $(ARGS)

# What needs one core runs beside tests that wait. After changes to compiled modules, run `make test-compiled`, too, as
# CI does.
check: .venv/installed ## what to run before each merge
	$(MAKE) --keep-going --no-print-directory --jobs=2 lint bytecode
	$(MAKE) --keep-going --no-print-directory --jobs=2 test beside-tests
	$(MAKE) --no-print-directory test-slow

# Where `make install` puts its files. Units in /etc/systemd/system belong to the administrator and cannot be masked, so
# they go to $(USR)/lib/systemd/system. The Debian package has its files in USR=/usr, below DESTDIR.
PREFIX := /opt/rtc3d-gateway
CONFIG := /etc/rtc3d-gateway
USR := /usr/local
DESTDIR :=

# Run as root. The service's user cannot read home directories, so its Python must not be in one; and it must be able to
# read what root installs, whatever root's umask is.
install: ## install it as a service; as root
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

# Build the site in build/site; a broken link is an error. (With --quiet, --strict would not count mkdocs' warnings.)
docs: .venv/installed ## the site, in build/site
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict

# The tools of a release, in a venv of their own: they must not change the versions that the tests use.
RELEASE_TOOLS := build/release-venv/complete
RELEASE_PYTHON := build/release-venv/bin/python

# Everything that a release publishes, in dist/: for each file a bill of materials, the licences, and the check sums.
# A further kind of file is a further target in ARTEFACTS. It puts its files, with a bill of its own, into dist/.
ARTEFACTS := wheels deb image
RELEASE := $(RELEASE_PYTHON) -B -m release

release: $(RELEASE_TOOLS) build/release-packages/complete ## everything to publish, in dist/
	@[ -z "$$(git status --porcelain)" ] || { echo 'A release is built from a commit: commit your changes first.' >&2; exit 1; }
	rm -rf dist && mkdir dist
	$(RELEASE).audit requirements-view.txt
	$(RELEASE).licences build/release-packages/bin/python dist/THIRD_PARTY.txt
	$(MAKE) --no-print-directory $(ARTEFACTS)
	$(MAKE) --no-print-directory check-sums
	@echo "Built in dist/: $$(ls dist | wc -l) files."

# The other targets. An sdist has only the first two of these files.
-include systemd/install.mk release/release.mk docs/docs.mk tests/tests.mk benchmarks/benchmarks.mk

# $(call timed,WHAT,EXPECTED TIME,COMMANDS): say what is done and how long it takes, do it quietly, say how long it took.
define timed
@set -e; echo '$(1) (about $(2)) …'; start=$$(date +%s); $(3); echo "Done in $$(($$(date +%s) - start)) s."
endef

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

# Build the programs in examples/ whose tools are installed, and say which were left out and why.
examples: .venv/installed ## build the programs in examples/
	$(MAKE) --no-print-directory -C examples PYTHON='$(CURDIR)/$(BIN)/python'

samples: .venv/installed ## record the sample take and the sample C3D file again
	$(BIN)/python examples/make_samples.py

# lcm-gen appends to an existing __init__.py, so delete the old files first.
lcm-types: .venv/installed ## generate the Python types from the .lcm files
	rm -f lcm_types/rtc3d/*.py
	$(BIN)/lcm-gen --python --ppath lcm_types lcm_types/rtc3d/*.lcm

clean: ## delete .venv and everything that was built
	rm -rf .venv build dist examples/build

help: ## print these lines
	@sed -n 's/^\([a-z-]*\):.* ## /\1\t/p' $(MAKEFILE_LIST) | expand --tabs=20
