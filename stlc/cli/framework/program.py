"""Command-line programs: a program is a package with one module per command, each imported only when needed.

`stlc` and `python -m benchmarks` are programs. To add a command, add a module to the package, or a package
with the command in its `__init__.py`. The module has one function marked with `command`, or a variable
`GROUP` with a group of subcommands. Modules import little at the top, so that `--help` stays fast.
"""

from __future__ import annotations

import inspect
import pkgutil
import signal
import sys
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext, suppress
from dataclasses import dataclass, field, fields, is_dataclass
from functools import cache
from importlib import import_module
from pathlib import Path
from types import FrameType
from typing import Annotated, Any, Literal, TypeVar, get_args, get_origin, get_type_hints

import typer

from stlc.activity import PULSE
from stlc.cli.framework import completion
from stlc.cli.framework.errors import INTERRUPTED, TERMINATED
from stlc.cli.framework.errors import report as report_error
from stlc.cli.framework.help import CommandHelp, ProgramHelp
from stlc.cli.framework.options import JsonOption
from stlc.cli.framework.output import COLOR, QUIET, Answer, ColorMode, emit, noticing, silence
from stlc.diagnostics import PluginError, usage
from stlc.foreign import driving
from stlc.options import Option
from stlc.registry import Registry
from stlc.version import __version__

F = TypeVar("F", bound=Callable[..., Any])

HELP_NAMES = ("-h", "--help")
_MARKED: dict[str, tuple[str, ...]] = {}
"""`module:function` of a command -> its examples."""


def command(*examples: str, drives: bool = False) -> Callable[[F], F]:
    """Return a decorator that marks a function as the command of its module.

    `examples` are command lines for the help text. The first paragraph of the function's docstring is the
    summary of the help text; the other paragraphs follow the examples. Each field of a dataclass parameter
    becomes an option; see `flat`. If `drives`, the command runs the Python that the files of a run name.
    """

    def mark(function: F) -> F:
        if drives:
            function = driving(True)(function)
        _MARKED[_place(function)] = examples
        return function

    return mark


def is_command(found: object) -> bool:
    """True for a function that `command` marked, and for a group of commands."""
    return isinstance(found, typer.Typer) or (inspect.isfunction(found) and _place(found) in _MARKED)


def _place(function: Callable[..., Any]) -> str:
    return f"{function.__module__}:{function.__name__}"


def group(sentence: str, *examples: str, default: Callable[..., None] | None = None) -> typer.Typer:
    """Return a group of commands, such as `stlc runs`, whose help begins with `sentence`.

    If no subcommand is given, `default` is called; without a default the help is shown.
    """
    made = typer.Typer(help=describe(sentence, *examples), invoke_without_command=True, rich_markup_mode=None)
    made.callback()(default or only_help)
    return made


def subcommand(made: typer.Typer, name: str, *examples: str) -> Callable[[F], F]:
    """Return a decorator that adds a function as subcommand `name` to the group `made`.

    The function's docstring is the help text, as for `command`.
    """

    def add(function: F) -> F:
        made.command(name, cls=CommandHelp, help=_help(function, examples))(flat(function))
        return function

    return add


def describe(sentence: str, *examples: str, note: str = "") -> str:
    """Return the help text of a command: a sentence, example command lines, then notes."""
    shown = "\b\nExample:\n" if len(examples) == 1 else "\b\nExamples:\n"
    lines = "\n".join(f"  {example}" for example in examples)
    return "\n\n".join(part for part in (sentence, shown + lines if examples else "", note) if part)


def _help(function: Callable[..., Any], examples: Sequence[str]) -> str:
    paragraphs = [" ".join(part.split()) for part in inspect.cleandoc(function.__doc__ or "").split("\n\n")]
    return describe(paragraphs[0], *examples, note="\n\n".join(paragraphs[1:]))


def only_help(context: typer.Context) -> None:
    """Print the help of a group that was called without a subcommand, and exit with code 2.

    This is also what `stlc` without a command does.
    """
    if context.invoked_subcommand is None:
        emit(context.get_help())
        raise typer.Exit(2)


def flat(function: Callable[..., Any]) -> Callable[..., Any]:
    """Return the function that typer calls for a command; it prints the `Answer` and returns the exit code.

    A parameter that is a dataclass becomes several options, one per field. Their defaults are the fields of
    the parameter's default. A function declared to return an `Answer` gets the option `--json`; its value is
    passed to the function only if the function has a parameter `json`.
    """
    hints = _parameter_hints(function)
    signature = inspect.signature(function)
    groups: dict[str, Any] = {name: hint for name, hint in hints.items() if is_dataclass(hint)}
    returned = signature.return_annotation  # a text, where the module postpones annotations
    answers = get_origin(returned) is Answer or str(returned).startswith("Answer[")
    passed = "json" in signature.parameters
    spread: list[inspect.Parameter] = []
    told: dict[str, tuple[str | None, str]] = {}
    for name, parameter in signature.parameters.items():
        if name not in groups:
            spread.append(parameter.replace(annotation=hints.get(name)))
            continue
        own = get_type_hints(groups[name], include_extras=True)
        told |= Option.described(groups[name])
        spread += [
            parameter.replace(
                name=each.name, annotation=own[each.name], default=getattr(parameter.default, each.name)
            )
            for each in fields(groups[name])
        ]
    if answers and not passed:
        option = inspect.Parameter.POSITIONAL_OR_KEYWORD
        spread.append(inspect.Parameter("json", option, default=False, annotation=JsonOption))
    read = {
        each.name: (each.default, parse) for each in spread if (parse := Option.parts(each.annotation)[2])
    }
    spread = [_on_command_line(each, *told.get(each.name, (None, ""))) for each in spread]

    def run(**values: Any) -> Any:
        as_json = values["json"] if passed else values.pop("json", False)
        for name, (default, parse) in read.items():
            values[name] = default if values[name] in (None, []) else parse(values[name])
        for name, kind in groups.items():
            values[name] = kind(**{each.name: values.pop(each.name) for each in fields(kind)})
        answer = function(**values)
        if not isinstance(answer, Answer):
            return answer
        return answer.print(f"{function.__module__.rpartition('.')[2]}/1", as_json=as_json)

    run.__name__, run.__doc__ = function.__name__, function.__doc__
    run.__signature__ = signature.replace(parameters=spread)  # type: ignore[attr-defined]
    run.__annotations__ = {each.name: each.annotation for each in spread}
    return run


def _on_command_line(parameter: inspect.Parameter, metavar: str | None, told: str) -> inspect.Parameter:
    """Return a parameter as typer declares it, if an `Option` or the docstring (`told`) describes it."""
    kind, option, parse = Option.parts(parameter.annotation)
    if option is None and not told:
        return parameter
    option = option or Option()
    help_, _, shown = (told or option.help).removesuffix(".").partition("; by default ")
    if parse is not None or option.many:
        kind = list[str] | None if option.many else str | None
        parameter = parameter.replace(default=None)
    found = typer.Option(
        *Option.flags_of(parameter.name, option),
        help=f"{help_}.",
        metavar=metavar or option.metavar,
        min=option.least,
        max=option.most,
        show_default=shown or True,
        autocompletion=getattr(completion, option.names, None),
    )
    return parameter.replace(annotation=Annotated[kind, found])


def _parameter_hints(function: Callable[..., Any]) -> dict[str, Any]:
    """Types of the parameters of a function; its result may be of a type that is not loaded yet."""
    hints = {name: hint for name, hint in function.__annotations__.items() if name != "return"}
    holder = type("Hints", (), {"__annotations__": hints, "__module__": function.__module__})
    return get_type_hints(holder, include_extras=True)


@dataclass(frozen=True, slots=True)
class Program:
    """A command-line program whose commands are the modules of a package.

    Attributes:
        name: name of the program, as it is typed.
        help: help text of the program.
        package: dotted name of the package of commands.
        groups: title of a group in the help text -> names of its commands, in this order; other commands
            follow in alphabetical order.
        moved: name of a former command -> command line that replaces it.
        elsewhere: commands of other packages; those of `package` come before them.
        drives: whether all commands run the Python that the files of a run name.
    """

    name: str
    help: str
    package: str
    groups: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    moved: Mapping[str, str] = field(default_factory=dict)
    drives: bool = False
    elsewhere: Registry[Any] | None = None

    def names(self) -> list[str]:
        """Return the names of all commands, in the order of the help text."""
        own, others = _modules_of(self.package), self.elsewhere or ()
        grouped = [name for names in self.groups.values() for name in names]
        ordered = [*(name for name in grouped if name in own), *sorted(own.difference(grouped))]
        return [*ordered, *(name for name in others if name not in own)]

    def _has(self, name: str) -> bool:
        return name in _modules_of(self.package) or (self.elsewhere is not None and name in self.elsewhere)

    def made(self, only: str = "") -> typer.Typer:
        """Return the typer application with the command `only`.

        If no command has this name, the application has all commands. A command of another package that
        cannot be loaded then says so in its help.

        Raises:
            PluginError: S206, the command `only` of another package cannot be loaded.
        """
        app = typer.Typer(
            name=self.name,
            cls=type("_Help", (ProgramHelp,), {"titles": self.groups}),
            help=self.help,
            rich_markup_mode=None,
            pretty_exceptions_enable=False,
            add_completion=self.name.isidentifier(),
            context_settings={"help_option_names": list(HELP_NAMES)},
        )
        app.callback(invoke_without_command=True)(_global_options)
        for name in [only] if self._has(only) else self.names():
            try:
                self._add(app, name)
            except PluginError as error:
                if name == only:
                    raise
                app.command(name, help=f"{error.diagnostics[0].message}.")(lambda: None)
        return app

    def parser(self, only: str = "") -> Any:
        """Return the parser of the command `only`, or of the whole program; it is built once and cached."""
        key = (self.package, only if self._has(only) else "")
        if key not in _PARSERS:
            _PARSERS[key] = typer.main.get_command(self.made(only))
            spare_adapters(_PARSERS[key])
            name_values(_PARSERS[key])
        return _PARSERS[key]

    def _add(self, app: typer.Typer, name: str) -> None:
        if name in _modules_of(self.package):
            own = vars(import_module(f"{self.package}.{name}"))
            found = own.get("GROUP") or own.get(name) or own[f"{name}_"]
        else:
            assert self.elsewhere is not None
            found = self.elsewhere.get(name)
        if isinstance(found, typer.Typer):
            app.add_typer(found, name=name)
        else:
            about = _help(found, _MARKED[_place(found)])
            app.command(name, cls=CommandHelp, help=about)(flat(found))

    def run(self, argv: Sequence[str] | None = None) -> int:
        """Run a command line and return its exit code.

        All exceptions of commands are caught here. Each becomes a message and an exit code; see
        `stlc.cli.framework.errors`.

        Args:
            argv: the arguments without the program's name; by default those of the process.
        """
        front, rest = _split(sys.argv[1:] if argv is None else argv)
        QUIET.set(bool({"-q", "--quiet"} & {*front}))
        stopped: list[int] = []
        try:
            with _stoppable() as stopped, noticing(), driving(self.drives):
                name = rest[0] if rest else ""
                if name in self.moved:
                    raise usage(f"there is no command `{name}`", self.moved[name])
                words = [*front, *rest]
                with nullcontext() if QUIET.get() else PULSE.beating():
                    code = self.parser(name).main(args=words, prog_name=self.name, standalone_mode=False)
                if stopped and code == INTERRUPTED:  # the parser turns Ctrl-C into an exit code
                    code = report_error(SystemExit(stopped[0]), rest)
        except BaseException as error:  # the boundary
            code = report_error(SystemExit(stopped[0]) if stopped else error, rest)
        _flush()
        return code if isinstance(code, int) else 0


@cache
def _modules_of(package: str) -> frozenset[str]:
    """Names of the modules of a package."""
    return frozenset(each.name for each in pkgutil.iter_modules(import_module(package).__path__))


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
    """Split `arguments` into options of the program, such as `--quiet`, and all others; return both lists.

    Options of the program may stand anywhere before `--`.
    """
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
    """Flush the streams, so that a closed pipe causes no message of the interpreter at exit."""
    for stream in (sys.stdout, sys.stderr):
        try:
            stream.flush()
        except (AttributeError, ValueError):
            continue
        except OSError:
            silence(stream)


@contextmanager
def _stoppable() -> Iterator[list[int]]:
    """Context in which Ctrl-C and SIGTERM raise an exception, so that the `finally` blocks of a command run.

    Yields a list, to which the exit code of each received signal is appended. The list is needed because
    interrupted C code may replace the exception by another one.
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


@contextmanager
def noting_signals() -> Iterator[list[int]]:
    """Context in which Ctrl-C and SIGTERM are only noted; the caller stops and saves what it has.

    If that takes too long, `stlc.stopping` ends the command. A signal that the process ignores stays ignored:
    shells start what runs in the background in this way. Yields a list, to which the exit code of each
    received signal is appended.
    """
    noted: list[int] = []
    if threading.current_thread() is not threading.main_thread():
        yield noted
        return

    def note(number: int, _frame: FrameType | None) -> None:
        noted.append(INTERRUPTED if number == signal.SIGINT else TERMINATED)

    heeded = [each for each in (signal.SIGINT, signal.SIGTERM) if signal.getsignal(each) != signal.SIG_IGN]
    before = {number: signal.signal(number, note) for number in heeded}
    try:
        yield noted
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


# ------------------------------------------------------- option values: metavars, no pydantic

_METAVARS = {"int": "N", "float": "X", "str": "TEXT", "Path": "PATH"}
_METAVARS |= {"integer": "N", "integer range": "N", "float range": "X", "text": "TEXT", "path": "PATH"}


def _params(command: Any) -> Iterator[Any]:
    """Yield the parameters of a command and of all its subcommands."""
    queue = [command]
    while queue:
        entry = queue.pop()
        queue.extend(getattr(entry, "commands", {}).values())
        yield from getattr(entry, "params", ())
        if hasattr(entry, "get_help_option"):  # it creates the option on first use, and keeps it
            option = entry.get_help_option(typer.Context(entry, help_option_names=list(HELP_NAMES)))
            if option is not None:
                yield option


def name_values(command: Any) -> None:
    """Set the placeholders of options in help texts, such as `NAME`, so that no Python types are shown.

    Only options without a placeholder (metavar) are changed. Those of subcommands are included.
    """
    for param in _params(command):
        if hasattr(param, "display_type_rich") and param.param_type_name == "argument":
            param.display_type_rich = lambda **_: ""  # the metavar suffices
        if param.metavar is None and param.param_type_name == "option" and not param.is_flag:
            kind = getattr(getattr(param, "type_descriptor", None), "annotation", None)
            words = get_args(kind) or getattr(getattr(param, "type", None), "choices", ())
            name = getattr(kind, "__name__", getattr(getattr(param, "type", None), "name", ""))
            param.metavar = "|".join(map(str, words)) if words else _METAVARS.get(name)


#
# Newer releases of typer build a pydantic adapter for every parameter of the running command, which takes a
# tenth of a second. Texts, paths and numbers within bounds are converted here; typer converts the others.
# Releases without adapters are not changed.

_SLOT = "_runtime_param"


def spare_adapters(command: Any) -> None:
    """Replace the converters of all parameters of a command, and of its subcommands, to save time.

    The converters of typer are slow to build. Their replacements convert texts, paths and numbers within
    their bounds, and build typer's converter only for other values.
    """
    for param in _params(command):
        if getattr(param, _SLOT, param) is None and hasattr(param, "type_descriptor"):
            setattr(param, _SLOT, _AsGiven())


class _AsGiven:
    """Substitute for typer's converter of one parameter, which is slow to build.

    Typer's converter is built only for a value that needs conversion.
    """

    def coerce(self, value: Any, *, param: Any, ctx: Any) -> Any:
        """Return `value` converted to the annotated type of the parameter `param`."""
        several = param.multiple or param.nargs == -1
        if value is None:
            return () if several else None
        kind, info = param.type_descriptor.annotation, param.type_descriptor.parameter_info
        if several and get_origin(kind) is list and isinstance(value, list | tuple):
            found = [_converted(item, get_args(kind)[0], info) for item in value]
            if None not in found:
                return found
        elif not several and (one := _converted(value, kind, info)) is not None:
            return one
        setattr(param, _SLOT, None)
        return param.get_runtime_param().coerce(value, param=param, ctx=ctx)


def _converted(value: Any, kind: Any, info: Any) -> Any:
    """Return a value as one of type `kind`, within the bounds of an option; None if typer must convert it."""
    if kind in (str, bool) and type(value) is kind:
        return value
    if get_origin(kind) is Literal:
        return value if isinstance(value, str) and value in get_args(kind) else None
    if kind is Path and isinstance(value, str | Path):
        return Path(value)
    if kind in (int, float) and isinstance(value, str | kind):
        with suppress(ValueError):
            number = kind(value)
            if (info.min is None or number >= info.min) and (info.max is None or number <= info.max):
                return number
    return None
