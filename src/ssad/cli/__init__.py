"""Command line: one short function per command. Heavy imports are inside them, so that --help is quick."""

from __future__ import annotations

import contextlib
import os
import sys
import warnings
from errno import ENOSPC
from typing import Annotated, Any

import typer

from ssad.cli import data, exchange, looking, planning, running
from ssad.cli.importing import ExportGroup, register
from ssad.cli.listing import ALIASES, LISTS
from ssad.cli.train import train_app
from ssad.core.errors import SSADError, missing_extra, unknown_name
from ssad.core.version import __version__
from ssad.core.wording import terminal_columns, wrapped_line

app = typer.Typer(
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)
imports = typer.Typer(
    help="Import maps, routes and scenarios of other programs, and logged drives.", no_args_is_help=True
)
app.add_typer(imports, name="import")
exports = typer.Typer(
    help="Export scenarios, or what a run has made, for other programs.", no_args_is_help=True, cls=ExportGroup
)
app.add_typer(exports, name="export")
register(exports, imports)
exports.command("texture")(exchange.export_texture)
exports.command("light")(exchange.export_light)
imports.command("map")(exchange.import_map)
imports.command("routes")(exchange.import_routes)
imports.command("drive")(exchange.import_drive)


def show_version(is_requested: bool) -> None:
    """Print the version and exit, if requested."""
    if is_requested:
        print(f"ssad {__version__}")
        raise typer.Exit


@app.callback()
def about(
    version: Annotated[
        bool, typer.Option("--version", help="Show the version and exit.", is_eager=True, callback=show_version)
    ] = False,
) -> None:
    """SSAD: how safe and robust is an autonomous-driving system in safety-critical scenarios?"""


for command in (
    running.run,
    planning.plan,
    running.report,
    running.compare,
    running.replay,
    looking.detect,
    looking.show,
    data.shift,
    data.score,
    data.record,
):
    app.command()(command)
app.add_typer(train_app, name="train")


@app.command("list")
def list_names(
    list_name: Annotated[str | None, typer.Argument(metavar="[WHAT]", help=f"One of: {', '.join(LISTS)}.")] = None,
) -> None:
    """List the names that other commands and suites accept. Without WHAT: all lists, scenarios by set and class."""
    selected_list = ALIASES.get(list_name or "", list_name)
    if selected_list is not None and selected_list not in LISTS:
        raise unknown_name("list", str(list_name), [*LISTS, *ALIASES])
    for name, make_rows in LISTS.items():
        if selected_list not in (None, name):
            continue
        try:
            # A list may need packages of an extra; the other lists are still shown.
            entries = make_rows()
        except ModuleNotFoundError as error:
            missing = missing_extra(error, f"the list of {name}")
            if missing is None or selected_list is not None:
                raise (missing or error) from None
            entries = {str(missing): ""}
        if selected_list is None:
            print(f"{name}:")
            if name == "scenarios":  # hundreds of single scenarios: only if this list is selected
                entries = {
                    entry: description
                    for entry, description in entries.items()
                    if description.startswith(("set", "class"))
                }
        width = max((len(entry) for entry in entries), default=0)
        for entry, description in entries.items():
            print(f"{'  ' if selected_list is None else ''}{entry:<{width}}  {description}".rstrip())


@app.command()
def doctor() -> None:
    """Check this machine: what works, what is missing. Exit code 1: something that every run needs is broken."""
    from ssad.cli.doctor import examine

    is_broken = False
    for finding in examine():
        is_broken |= finding.state == "broken"
        print(f"{finding.state:<8} {finding.name:<12} {finding.detail}")
    raise typer.Exit(1 if is_broken else 0)


def give_up_output() -> None:
    """Discard all further output, so that the end of the process raises nothing."""
    with contextlib.suppress(OSError, ValueError):
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def print_message(line: str) -> None:
    """Print a line to standard error: broken at words where a terminal shows it, whole in a file or a pipe."""
    columns = terminal_columns(sys.stderr)
    print(line if columns is None else wrapped_line(line, columns), file=sys.stderr)


def _show_warning(message: Warning | str, category: type[Warning], *_: object, **__: object) -> None:
    """Print a warning to the user as one line; those for developers keep their category."""
    kind = "" if issubclass(category, FutureWarning | UserWarning) else f"{category.__name__}: "
    print_message(f"warning: {kind}{message}")


def main() -> None:
    """Entry point: an error that the user can fix becomes one line and exit code 2."""
    # click's UsageError, which typer does not export
    usage_error: Any = typer.BadParameter.__mro__[1]
    warnings.showwarning = _show_warning
    try:
        code = app(standalone_mode=False)
        # Flush here: a closed pipe would otherwise raise while the interpreter exits, outside this handler.
        sys.stdout.flush()
    except (BrokenPipeError, SystemExit) as exit_error:  # `ssad ... | head`: the reader has closed the pipe
        if (
            isinstance(exit_error, SystemExit) and type(sys.stdout).__name__ != "PacifyFlushWrapper"
        ):  # typer's, after EPIPE
            raise
        give_up_output()
        sys.exit(141)  # as a program that the signal ends
    except OSError as error:
        subject = f"{error.filename}: " if error.filename else "standard output: " if error.errno == ENOSPC else ""
        give_up_output()
        print_message(f"error: {subject}{error.strerror or error}")
        sys.exit(2)
    except SSADError as error:
        print_message(f"error: {error}")
        sys.exit(2)
    except ModuleNotFoundError as error:  # packages of extras are imported where they are needed
        missing = missing_extra(error, "this command")
        if missing is None:
            raise
        print_message(f"error: {missing}")
        sys.exit(2)
    except typer.Abort:
        sys.exit(130)
    except usage_error as error:
        if type(error).__name__ == "NoArgsIsHelpError":  # its message is the help
            print(error.format_message())
            sys.exit(2)
        command = error.ctx.command_path if error.ctx is not None else "ssad"
        message = " ".join(
            error.format_message().replace("Value error, ", "").split()
        )  # pydantic's, and choices in lines
        print_message(f"error: {message} (see: {command} --help)")
        sys.exit(2)
    sys.exit(code if isinstance(code, int) else 0)
