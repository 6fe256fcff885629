"""The commands of the program. The module of a command is imported only when the command is needed."""

from collections.abc import Iterator, Mapping
from importlib import import_module
from typing import Any, Final

import typer
import typer.core

COMMANDS: Final = {
    "run": "gateway.cli.run:run",
    "doctor": "gateway.cli.doctor:doctor",
    "simulate": "gateway.cli.simulate:simulate",
    "demo": "gateway.cli.demo:demo",
    "list": "gateway.cli.list_gateways:list_gateways",
    "view": "gateway.cli.view:view",
    "echo": "gateway.cli.echo:echo",
    "top": "gateway.cli.top:top",
    "params": "gateway.cli.params:params",
    "record": "gateway.cli.record:record",
    "replay": "gateway.cli.replay:replay",
    "export": "gateway.cli.export:export",
    "take": "gateway.cli.take:app",
    "config": "gateway.cli.config:app",
}
"""Each command, in the order of ``--help``, with its function, or its ``typer.Typer`` if it has sub-commands.

Their modules must be quick to import: ``--help`` shows the first sentence of each function, and shells that
complete a line do not wait. So a function imports what it needs when it runs. A test checks this.
"""

ALIASES: Final = {"check": "gateway.cli.config:check"}
"""Other names of commands, which are not listed: ``check`` is ``config check``."""


class LazyGroup(typer.core.TyperGroup):
    """The group of all commands."""

    def __init__(self, **settings: Any) -> None:
        super().__init__(**settings)
        self.commands: Any = _LazyCommands(COMMANDS)

    def list_commands(self, ctx: Any) -> list[str]:  # noqa: ARG002 - overrides
        """Return the names of the commands in the order of the table."""
        return list(self.commands)

    def get_command(self, ctx: Any, cmd_name: str) -> Any:  # noqa: ARG002 - overrides
        """Return a command by its name or its alias; None if there is none."""
        return self.commands.get(cmd_name) or _LazyCommands(ALIASES).get(cmd_name)


class _LazyCommands(Mapping[str, Any]):
    """Commands by name, each imported when it is looked up."""

    def __init__(self, table: Mapping[str, str]) -> None:
        self._table = table

    def __getitem__(self, name: str) -> Any:
        module, _, attribute = self._table[name].partition(":")
        target = getattr(import_module(module), attribute)
        app = typer.Typer()
        if isinstance(target, typer.Typer):
            app.add_typer(target, name=name)
        else:
            app.command(name)(target)
        return typer.main.get_group(app).commands[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._table)

    def __len__(self) -> int:
        return len(self._table)
