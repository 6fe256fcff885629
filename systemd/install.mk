# The steps of `make install` (Makefile), and its opposite.
MAN_PAGE := $(USR)/share/man/man1/rtc3d-gateway.1
BASH_COMPLETION := $(USR)/share/bash-completion/completions/rtc3d-gateway
FISH_COMPLETION := $(USR)/share/fish/vendor_completions.d/rtc3d-gateway.fish
UNITS := rtc3d-gateway.service rtc3d-gateway@.service

.PHONY: install-program install-files uninstall

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
uninstall: ## take it away again, without the configuration and the data; as root
	[ ! -d /run/systemd/system ] || systemctl stop rtc3d-gateway.service 'rtc3d-gateway@*.service'
	[ ! -d /run/systemd/system ] || systemctl disable $(UNITS)
	rm -f $(UNITS:%=$(USR)/lib/systemd/system/%) $(USR)/lib/sysusers.d/rtc3d-gateway.conf \
	    $(USR)/lib/tmpfiles.d/rtc3d-gateway.conf $(USR)/bin/rtc3d-gateway $(MAN_PAGE) $(BASH_COMPLETION) \
	    $(FISH_COMPLETION) $(CONFIG)/gateway.schema.json
	rm -rf $(PREFIX)/venv
	-rmdir $(PREFIX)
	[ ! -d /run/systemd/system ] || systemctl daemon-reload
