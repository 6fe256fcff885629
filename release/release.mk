# What `make release` (Makefile) builds, the compiled gateway, and the locked versions.
.PHONY: wheel wheels compiled deb deb-lock image check-sums reproducible wheelhouse lock

# Build a wheel for `pipx install dist/*.whl`, compiled for $(PYTHON) if possible.
DIST := dist

wheel: ## a wheel for $(PYTHON), compiled if possible
	@$(PYTHON) -B -m release.build --dist $(DIST) wheel

# The sdist, a wheel for any Python, and a compiled wheel for each Python that this machine has.
wheels: $(RELEASE_TOOLS) build/release-packages/complete
	$(RELEASE).wheels
	$(RELEASE).sbom build/release-packages/bin/python dist/rtc3d_gateway-*.tar.gz dist/rtc3d_gateway-*.whl

# Build the Debian package in dist/. It has the Python of Debian 12, and needs that of the machine to be the same.
deb: build/wheelhouse/complete $(RELEASE_TOOLS) build/release-packages/complete ## the Debian package
	rm -rf build/deb/wheel
	build/wheelhouse-venv/bin/python -B -m release.build --dist build/deb/wheel compiled
	build/wheelhouse-venv/bin/python -B -m release.deb.build build/deb/wheel/*.whl build/wheelhouse
	$(RELEASE).sbom build/release-packages/bin/python dist/rtc3d-gateway_*.deb

# Renew the versions of the packages of Debian that the Debian package contains.
DEB_LOCK := release/deb/packages.txt

deb-lock: ## renew the versions of Debian's packages in the Debian package
	apt-get update
	$(PYTHON) -B -m release.deb.packages --newest >build/packages.txt && mv build/packages.txt $(DEB_LOCK)

# Build the container image from the Debian package, in dist/ as an OCI archive; it needs podman, and the registry of the base.
# The archive is the same for the same package and base. IMAGE_OPTIONS=--build-arg=BASE=… takes another base.
IMAGE_OPTIONS ?=
VERSION = $(shell sed -n 's/^__version__.*"\(.*\)"/\1/p' gateway/__init__.py)
OCI = dist/rtc3d-gateway_$(VERSION)_amd64.oci.tar

image: deb ## the container image
	rm -rf build/image $(OCI)
	set -e; export SOURCE_DATE_EPOCH=$$(git log -1 --format=%ct); \
	    release/image/build dist/rtc3d-gateway_$(VERSION)_amd64.deb $(IMAGE_OPTIONS); \
	    podman save --quiet --format oci-dir --output build/image rtc3d-gateway:$(VERSION); \
	    tar --create --file build/image.tar --sort=name --mtime=@$$SOURCE_DATE_EPOCH --owner=0 --group=0 --numeric-owner \
	        --mode=u=rwX,go=rX --directory build/image blobs index.json oci-layout; \
	    mv build/image.tar $(OCI)
	$(RELEASE).sbom build/release-packages/bin/python $(OCI)

# The check sums of all files in dist/, also of those that were built on other machines.
check-sums:
	mkdir -p build; rm -f dist/SHA256SUMS
	cd dist && LC_ALL=C sha256sum * >../build/SHA256SUMS && mv ../build/SHA256SUMS .

# Build a release twice, in different surroundings, and compare the check sums.
reproducible: ## build a release twice, and compare
	$(PYTHON) -B -m release.reproducible

# The compiled gateway, for tests and measurements. Programs run with $(COMPILED) import it instead of the sources.
COMPILED := PYTHONSAFEPATH=1 PYTHONPATH='$(CURDIR)/build/compiled'

# What the compiled modules are built from.
SOURCES := gateway lcm_types config release pyproject.toml README.md LICENSE

compiled: build/compiled/complete ## the compiled gateway, in build/compiled

build/compiled/complete: .venv/installed $(shell find $(SOURCES) -type f ! -path '*__pycache__*')
	rm -rf build/compiled
	$(MAKE) --no-print-directory wheel PYTHON=$(BIN)/python DIST=build/compiled/wheel
	$(BIN)/pip install --quiet --no-deps --target build/compiled build/compiled/wheel/*.whl
	touch $@

# Download the packages that an installation needs: its tests have no network.
wheelhouse: build/wheelhouse/complete

build/wheelhouse/complete: pyproject.toml requirements-view.txt release/build-requirements.txt
	rm -rf build/wheelhouse build/wheelhouse-venv
	$(SYSTEM_PYTHON) -m venv build/wheelhouse-venv
	set -e; for file in requirements-view.txt release/build-requirements.txt; do \
	    build/wheelhouse-venv/bin/pip download --quiet --dest build/wheelhouse --require-hashes --requirement $$file; done
	build/wheelhouse-venv/bin/pip download --quiet --dest build/wheelhouse pip
	touch $@

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

# Renew the versions of all dependencies for every supported Python and platform: requirements-view.txt has those of all
# extras, and requirements.txt the same without the live view and Parquet, which a service does not need.
UV_COMPILE := build/lock-venv/bin/uv pip compile --quiet --universal --python-version 3.11 --upgrade --generate-hashes \
    --no-annotate --no-header --no-emit-index-url

# What pyproject.toml requires for a build.
BUILD_REQUIRES = import tomllib; project = tomllib.load(open("pyproject.toml", "rb")); \
    hook = project["tool"]["hatch"]["build"]["targets"]["wheel"]["hooks"]["mypyc"]; \
    print(*project["build-system"]["requires"], *hook["dependencies"], sep="\n")

lock: ## renew the versions of all dependencies
	$(PYTHON) -m venv build/lock-venv
	build/lock-venv/bin/pip install --quiet uv
	$(UV_COMPILE) --all-extras --output-file requirements-view.txt pyproject.toml
	$(UV_COMPILE) --extra c3d --extra foxglove --extra lsl --extra systemd --constraint requirements-view.txt \
	    --output-file requirements.txt pyproject.toml
	build/lock-venv/bin/python -c '$(BUILD_REQUIRES)' | $(UV_COMPILE) --output-file release/build-requirements.txt -
	$(UV_COMPILE) --group release --constraint release/build-requirements.txt --output-file release/tool-requirements.txt
