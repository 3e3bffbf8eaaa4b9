"""Programs: a package of commands, a module each, imported when one is asked for, and the error boundary.

`stlc` and `python -m benchmarks` are programs. A new command is a new module in the package of commands that
holds one function marked with `command`, or a `GROUP` of functions. Nothing is imported that a command does
not need to be described, so that `--help` stays fast.
"""

from __future__ import annotations

import inspect
import pkgutil
import signal
import sys
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, fields, is_dataclass
from importlib import import_module
from pathlib import Path
from types import FrameType
from typing import Annotated, Any, Literal, TypeVar, get_args, get_origin, get_type_hints

import typer

from stlc.cli.framework.errors import INTERRUPTED, TERMINATED
from stlc.cli.framework.errors import report as report_error
from stlc.cli.framework.output import COLOR, PULSE, QUIET, ColorMode, emit, noticing, silence
from stlc.diagnostics import Diagnostic, UsageError
from stlc.version import __version__

F = TypeVar("F", bound=Callable[..., None])

HELP_NAMES = ("-h", "--help")
_MARKED: dict[str, tuple[str, ...]] = {}
"""`module:function` of a command -> its examples."""


def command(*examples: str) -> Callable[[F], F]:
    """Mark the function of its module that is the command, with examples of it as they are typed.

    The docstring is the help: its first paragraph says what the command does, the others come behind the
    examples. Parameters that are dataclasses are option groups; see `flat`.
    """

    def mark(function: F) -> F:
        _MARKED[f"{function.__module__}:{function.__name__}"] = examples
        return function

    return mark


def group(sentence: str, *examples: str, default: Callable[..., None] | None = None) -> typer.Typer:
    """A group of commands; without one of them `default` is called, else its help is shown."""
    made = typer.Typer(help=describe(sentence, *examples), invoke_without_command=True, rich_markup_mode=None)
    made.callback()(default or only_help)
    return made


def subcommand(made: typer.Typer, name: str, *examples: str) -> Callable[[F], F]:
    """Add a function to a group; as for `command`, its docstring is the help."""

    def add(function: F) -> F:
        made.command(name, help=_help(function, examples))(flat(function))
        return function

    return add


def describe(sentence: str, *examples: str, note: str = "") -> str:
    """The help of a command: one sentence, examples as they are typed, then what else is to be known."""
    shown = "\b\nExample:\n" if len(examples) == 1 else "\b\nExamples:\n"
    lines = "\n".join(f"  {example}" for example in examples)
    return "\n\n".join(part for part in (sentence, shown + lines if examples else "", note) if part)


def _help(function: Callable[..., None], examples: Sequence[str]) -> str:
    paragraphs = [" ".join(part.split()) for part in inspect.cleandoc(function.__doc__ or "").split("\n\n")]
    return describe(paragraphs[0], *examples, note="\n\n".join(paragraphs[1:]))


def only_help(context: typer.Context) -> None:
    """A group of commands without one of them: its help and exit code 2, as for `stlc` alone."""
    if context.invoked_subcommand is None:
        emit(context.get_help())
        raise typer.Exit(2)


def flat(function: Callable[..., None]) -> Callable[..., None]:
    """A command with its option groups spread: each field of a parameter that is a dataclass is an option.

    The defaults are those of the parameter's default, which is a value of the dataclass.
    """
    signature = inspect.signature(function, eval_str=True)
    groups: dict[str, Any] = {
        name: each.annotation for name, each in signature.parameters.items() if is_dataclass(each.annotation)
    }
    if not groups:
        return function
    spread: list[inspect.Parameter] = []
    for name, parameter in signature.parameters.items():
        if name not in groups:
            spread.append(parameter)
            continue
        hints = get_type_hints(groups[name], include_extras=True)
        spread += [
            parameter.replace(
                name=each.name, annotation=hints[each.name], default=getattr(parameter.default, each.name)
            )
            for each in fields(groups[name])
        ]

    def run(**values: Any) -> None:
        for name, kind in groups.items():
            values[name] = kind(**{each.name: values.pop(each.name) for each in fields(kind)})
        function(**values)

    run.__name__, run.__doc__ = function.__name__, function.__doc__
    run.__signature__ = signature.replace(parameters=spread)  # type: ignore[attr-defined]
    run.__annotations__ = {each.name: each.annotation for each in spread}
    return run


@dataclass(frozen=True, slots=True)
class Program:
    """A program.

    Attributes:
        name: as it is typed.
        help: of the whole program.
        package: of its commands.
        order: of commands in the help; others stand behind them by name.
        moved: commands that there were -> what is typed instead.
    """

    name: str
    help: str
    package: str
    order: tuple[str, ...] = ()
    moved: Mapping[str, str] = field(default_factory=dict)

    def names(self) -> list[str]:
        """All commands."""
        found = [each.name for each in pkgutil.iter_modules(import_module(self.package).__path__)]
        return [*(name for name in self.order if name in found), *sorted(set(found) - set(self.order))]

    def made(self, only: str = "") -> typer.Typer:
        """The program with one command alone, or all of them where there is none of that name."""
        names = self.names()
        app = typer.Typer(
            name=self.name,
            help=self.help,
            rich_markup_mode=None,
            pretty_exceptions_enable=False,
            add_completion=self.name.isidentifier(),
            context_settings={"help_option_names": list(HELP_NAMES)},
        )
        app.callback(invoke_without_command=True)(_global_options)
        for name in [only] if only in names else names:
            self._add(app, name)
        return app

    def parser(self, only: str = "") -> Any:
        """The parser of one command, or of the program, made once in a process; see `name_values`."""
        key = (self.package, only if only in self.names() else "")
        if key not in _PARSERS:
            _PARSERS[key] = typer.main.get_command(self.made(only))
            spare_adapters(_PARSERS[key])
            name_values(_PARSERS[key])
        return _PARSERS[key]

    def _add(self, app: typer.Typer, name: str) -> None:
        module = import_module(f"{self.package}.{name}")
        if hasattr(module, "GROUP"):
            app.add_typer(module.GROUP, name=name)
            return
        function = getattr(module, name, None) or getattr(module, f"{name}_")
        examples = _MARKED[f"{module.__name__}:{function.__name__}"]
        app.command(name, help=_help(function, examples))(flat(function))

    def run(self, argv: Sequence[str] | None = None) -> int:
        """Run a command line and return its exit code.

        The one place where an exception becomes a message and an exit code; see `stlc.cli.framework.errors`.

        Args:
            argv: the arguments without the program's name; by default those of the process.
        """
        front, rest = _split(sys.argv[1:] if argv is None else argv)
        QUIET.set(bool({"-q", "--quiet"} & {*front}))
        stopped: list[int] = []
        try:
            with _stoppable() as stopped, noticing():
                name = rest[0] if rest else ""
                if name in self.moved:
                    finding = Diagnostic("U101", f"there is no command `{name}`", help=(self.moved[name],))
                    raise UsageError(finding)
                words = [*front, *rest]
                with PULSE.beating():
                    code = self.parser(name).main(args=words, prog_name=self.name, standalone_mode=False)
        except BaseException as error:  # the boundary
            code = report_error(SystemExit(stopped[0]) if stopped else error, rest)
        _flush()
        return code if isinstance(code, int) else 0


_PARSERS: dict[tuple[str, str], Any] = {}
"""(package, command) -> its parser."""


def _show_version(wanted: bool) -> None:
    if wanted:
        emit(f"stlc {__version__}")
        raise typer.Exit


def _global_options(
    context: typer.Context,
    color: Annotated[ColorMode, typer.Option("--color", help="Whether the output may be coloured.")] = "auto",
    _quiet: Annotated[
        bool, typer.Option("--quiet", "-q", help="Print results, warnings and errors only.")
    ] = False,
    version: Annotated[
        bool,
        typer.Option("--version", "-V", help="Print the version.", is_eager=True, callback=_show_version),
    ] = False,
) -> None:
    COLOR.set(color)
    if not version:
        only_help(context)


def _split(arguments: Sequence[str]) -> tuple[list[str], list[str]]:
    """The options of the whole program and the rest: those may stand before or after the command."""
    front: list[str] = []
    rest: list[str] = []
    queue = list(arguments)
    while queue and queue[0] != "--":
        word = queue.pop(0)
        if word == "--color" and queue:
            front += [word, queue.pop(0)]
        elif word in ("-q", "--quiet") or word.startswith("--color="):
            front.append(word)
        else:
            rest.append(word)
    return front, [*rest, *queue]


def _flush() -> None:
    """Leave nothing in the buffers: what cannot be written must not become a message of the interpreter."""
    for stream in (sys.stdout, sys.stderr):
        try:
            stream.flush()
        except (AttributeError, ValueError):
            continue
        except OSError:
            silence(stream)


@contextmanager
def _stoppable() -> Iterator[list[int]]:
    """While a command runs, Ctrl-C and SIGTERM unwind it, so that its `finally` blocks run.

    Gives the exit codes of what came: code in C that is interrupted may raise something else instead.
    """
    stopped: list[int] = []
    if threading.current_thread() is not threading.main_thread():
        yield stopped
        return

    def interrupt(_number: int, _frame: FrameType | None) -> None:
        stopped.append(INTERRUPTED)
        raise KeyboardInterrupt

    def terminate(_number: int, _frame: FrameType | None) -> None:
        stopped.append(TERMINATED)
        raise SystemExit(TERMINATED)

    before = {signal.SIGTERM: signal.signal(signal.SIGTERM, terminate)}
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        before[signal.SIGINT] = signal.signal(signal.SIGINT, interrupt)
    try:
        yield stopped
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


# ------------------------------------------------------- values of options: names, and no pydantic

_METAVARS = {"int": "N", "float": "X", "str": "TEXT", "Path": "PATH"}
_METAVARS |= {"integer": "N", "integer range": "N", "float range": "X", "text": "TEXT", "path": "PATH"}


def _params(command: Any) -> Iterator[Any]:
    """The parameters of a command and of those below it."""
    queue = [command]
    while queue:
        entry = queue.pop()
        queue.extend(getattr(entry, "commands", {}).values())
        yield from getattr(entry, "params", ())
        yield from _help_option(entry)


def name_values(command: Any) -> None:
    """Give options without a metavar one that says what is expected: no types of Python in a help text."""
    for param in _params(command):
        if hasattr(param, "display_type_rich") and param.param_type_name == "argument":
            param.display_type_rich = lambda **_: ""  # its metavar says it
        if param.metavar is None and param.param_type_name == "option" and not param.is_flag:
            kind = getattr(getattr(param, "type_descriptor", None), "annotation", None)
            words = get_args(kind) or getattr(getattr(param, "type", None), "choices", ())
            name = getattr(kind, "__name__", getattr(getattr(param, "type", None), "name", ""))
            param.metavar = "|".join(map(str, words)) if words else _METAVARS.get(name)


#
# Newer releases of typer build a pydantic adapter for every parameter of a command that runs, which takes a
# tenth of a second. Most values are texts already; they are passed on, and typer converts the others.
# Releases that do without adapters are left alone.

_SLOT = "_runtime_param"


def spare_adapters(command: Any) -> None:
    """Let the parameters of a command, and of those below it, convert only what needs it."""
    for param in _params(command):
        if getattr(param, _SLOT, param) is None and hasattr(param, "type_descriptor"):
            setattr(param, _SLOT, _AsGiven())


def _help_option(command: Any) -> list[Any]:
    """The option `--help`, which a command makes when it is first asked for it and then keeps."""
    if not hasattr(command, "get_help_option"):
        return []
    option = command.get_help_option(typer.Context(command, help_option_names=list(HELP_NAMES)))
    return [] if option is None else [option]


class _AsGiven:
    """Stands in for typer's converter of one parameter until a value needs one."""

    def coerce(self, value: Any, *, param: Any, ctx: Any) -> Any:
        """The value as the command takes it."""
        several = param.multiple or param.nargs == -1
        if value is None:
            return () if several else None
        annotation = param.type_descriptor.annotation
        if several and get_origin(annotation) is list and isinstance(value, list | tuple):
            kinds = get_args(annotation)
            if len(kinds) == 1 and all(_fits(item, kinds[0]) for item in value):
                return list(value)
        elif not several and _fits(value, annotation):
            return value
        setattr(param, _SLOT, None)
        return param.get_runtime_param().coerce(value, param=param, ctx=ctx)


def _fits(value: Any, annotation: Any) -> bool:
    """Whether a value is already what its annotation says."""
    if annotation in (str, bool, int, float):
        return type(value) is annotation
    if get_origin(annotation) is Literal:
        return isinstance(value, str) and value in get_args(annotation)
    return annotation is Path and isinstance(value, Path)
