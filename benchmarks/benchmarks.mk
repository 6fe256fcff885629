# The benchmarks, and the programs that they compare the gateway with.
.PHONY: bench bench-quick bench-tests bench-sites bench-sites-quick native-peers zenohd

# Compare the gateway with a bare relay to Zenoh and LCM, and write benchmarks/results.json and docs/dev/performance.md.
# This takes half an hour and needs an idle machine. PARTS="ceiling loss" measures only these parts. bench-quick takes
# five minutes, gives rough figures, and does not change the document.
PARTS ?=

bench: .venv/bench build/compiled/complete zenohd native-peers bench-tests ## compare with bare relays; write docs/dev/performance.md
	$(COMPILED) tests/with-netns $(BIN)/python -m benchmarks $(PARTS)

bench-quick: .venv/bench build/compiled/complete native-peers bench-tests ## rough figures of `make bench` in five minutes
	$(COMPILED) tests/with-netns $(BIN)/python -m benchmarks --quick $(PARTS)

# Measure two sites with a router each, and the link between them, and write benchmarks/sites/results.json and
# docs/dev/scale.md. This takes half an hour and needs an idle machine, ip, tc and nsenter (Debian: iproute2, util-linux).
# PARTS as above. bench-sites-quick takes three minutes and does not change the document.
SITES := $(COMPILED) tests/with-netns $(BIN)/python -m benchmarks.sites

bench-sites: .venv/bench build/compiled/complete zenohd bench-tests native-peers ## measure two sites and their link; write docs/dev/scale.md
	$(SITES) $(PARTS)

bench-sites-quick: .venv/installed build/compiled/complete native-peers ## rough figures of `make bench-sites`
	$(SITES) --quick $(PARTS)

# Check that the gateway and the relay do the same work in the benchmarks, and that those with two sites count exactly.
bench-tests: .venv/installed
	MAKEFLAGS= $(BIN)/python tests/run.py tests/benchmarks

# Programs without Python: the subscribers of two sites, and the bare relays. Without cargo, the subscribers run in
# Python, which a few dozen of them keep busy; without the relays, the benchmarks do not compare with them.
NATIVE := benchmarks/native

native-peers: build/native/release/site-subscriber build/native/lcm-relay ## build the programs of the benchmarks that are not in Python

build/native/release/site-subscriber: $(addprefix $(NATIVE)/,Cargo.toml Cargo.lock site_subscriber.rs zenoh_relay.rs)
	cargo build --release --locked --quiet --manifest-path $(NATIVE)/Cargo.toml --target-dir build/native \
	|| echo 'site-subscriber and zenoh-relay not built: they need cargo'

build/native/lcm-relay: $(NATIVE)/lcm_relay.c
	mkdir -p $(@D)
	$(CC) -O2 -Wall -Wextra -o $@ $< -llcm \
	|| echo 'lcm-relay not built: it needs a C compiler and liblcm (Debian: liblcm-dev)'

# Build the router for the benchmarks, in the version of eclipse-zenoh; this takes five minutes, once. Without cargo,
# the benchmarks use a Python session as the router and report that.
zenohd: .venv/installed ## build the router of the benchmarks
	version=$$($(BIN)/python -c 'from importlib.metadata import version; print(version("eclipse-zenoh"))'); \
	cargo install zenohd --quiet --version $$version --locked --root build/zenohd \
	|| echo 'zenohd not built: the benchmarks use a Python session as the router'

.venv/bench: .venv/installed
	$(BIN)/pip install --quiet --group bench
	touch $@
