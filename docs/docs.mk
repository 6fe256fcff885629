# The documents, besides `make docs` (Makefile).
.PHONY: messages options site screenshots clone-url

# Write the messages of level WARNING and above from the source code into docs/reference/log-messages.md. A changed
# sentence keeps its advice; messages without advice are named. `make test` checks that the page is up to date.
messages: .venv/installed ## write the messages of the source code into docs/reference/log-messages.md
	$(BIN)/python -m tests.support.log_messages_page

# What people wrote below the help of a command stays.
options: .venv/installed ## write the help of the commands into docs/reference/commands.md
	$(BIN)/python -m tests.support.commands_page

# Commit the site of this version to the branch gh-pages, beside those of other versions: /1.0/, to which /latest/ leads.
# `git push origin gh-pages` publishes it.
site: .venv/installed ## commit the site of this version to the branch gh-pages
	set -e; version=$$($(BIN)/python -c 'from gateway import __version__; print(__version__.rpartition(".")[0])'); \
	export PATH=$(abspath $(BIN)):$$PATH NO_MKDOCS_2_WARNING=1; \
	mike deploy --config-file mkdocs-versions.yml --update-aliases --alias-type redirect $$version latest; \
	mike set-default --config-file mkdocs-versions.yml latest

# Make the pictures of the live view in docs/ again, in Debian's Chromium. Look at them before you commit them.
screenshots: .venv/installed ## make the pictures of the live view in docs/ again
	tests/with-netns unshare --uts sh -c 'echo mocap-pc >/proc/sys/kernel/hostname && exec $(BIN)/python -m tests.screenshots'

# Change the address of the repository in pyproject.toml and in the documents: make clone-url URL=https://…
URL ?=
OLD_URL = $(shell sed -n 's/^Repository = "\([^"]*\)".*/\1/p' pyproject.toml)

clone-url: ## enter the address of the repository, URL=https://…
	@[ -n '$(URL)' ] || { echo 'Give the new address: make clone-url URL=https://…' >&2; exit 2; }
	sed -i 's|$(OLD_URL)|$(URL)|g' pyproject.toml README.md docs/tutorial.md docs/how-to/service.md
