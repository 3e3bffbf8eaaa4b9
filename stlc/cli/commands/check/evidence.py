"""Evidence of a result of `stlc check`: its inputs with their hashes, its options, and its repetition."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

from stlc.cli.commands.check.options import Judging
from stlc.diagnostics import StlcError, usage
from stlc.files import File
from stlc.jsontext import dumps
from stlc.monitor.check import Question, monitor_of
from stlc.monitor.judgement import Evidence, InputFile
from stlc.records import read
from stlc.version import __version__

MAX_BYTES = 64_000_000
"""Largest file of a result that is repeated."""
_BLOCK = 1 << 20
_COMPARED = ("traces", "samples", "in_scope", "verdict", "satisfied_traces", "satisfied_share")
_EACH = ("name", "verdict", "robustness", "starts", "satisfied_share", "violated_traces", "judged")


def evidence_of(path: Path, question: Question, words: Mapping[str, Sequence[str]]) -> Evidence:
    """Evidence of the result on the trace file `path`: its inputs with their hashes, and the options."""
    return Evidence(__version__, _file(path), tuple(map(_file, _inputs(question))), words)


def _inputs(question: Question) -> list[Path]:
    """The specification, the files that it imports, and the system; those that exist as files."""
    if question.spec is None:  # the trace holds it, with its imports
        named, files, near = question.system, [], None
    else:
        near = File(question.spec).spec()
        spec = monitor_of(File(near).read(), question).spec
        named, files = question.system or spec.system, [near, *spec.imported_files()]
    with suppress(StlcError):
        files += [] if named is None else [File(named).system(near)]
    return [each for each in dict.fromkeys(files) if each.is_file()]


def _file(path: Path) -> InputFile:
    found, size = hashlib.sha256(), 0
    if path.is_file():
        with path.open("rb") as stream:
            while block := stream.read(_BLOCK):
                found.update(block)
                size += len(block)
        return InputFile(str(path), found.hexdigest(), size)
    for each in sorted(path.rglob("*")):  # a bag is a folder
        if each.is_file():
            inner = _file(each)
            found.update(f"{each.relative_to(path)}\0{inner.sha256}\0".encode())
            size += inner.bytes
    return InputFile(str(path), found.hexdigest(), size)


# ---------------------------------------------------------------------- repetition


class Repetition:
    """A stored result that is to be made again.

    Args:
        path: file with the output of `stlc check --json`.

    Raises:
        UsageError: U101, the file holds no such output; U102, it does not exist, or a file that the result
            was made from does not, or has changed since.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        result = _result(path)
        self.entries: list[Mapping[str, Any]] = result.get("files", [result])
        try:
            evidence = [
                read(Evidence, entry["evidence"], "evidence") for entry in self.entries if "evidence" in entry
            ]
            if not evidence or any(each.options != evidence[0].options for each in evidence):
                raise ValueError("its results have no options, or different ones")
            self.options = Judging.from_words(evidence[0].options)
            self.traces = [each.trace.path for each in evidence]
            for file in {each.path: each for e in evidence for each in (e.trace, *e.inputs)}.values():
                found = Path(file.path)
                if not (found.is_file() or found.is_dir()):
                    message = f"`{file.path}`, from which {path} was made, is not here"
                    raise usage(message, "run it in the folder of the first check", code="U102")
                if _file(found).sha256 != file.sha256:
                    raise usage(f"`{file.path}` has changed since {path} was made", code="U102")
        except (LookupError, TypeError, ValueError, AttributeError) as error:
            raise usage(f"`{path}` holds no evidence of a result: {error}", "stlc check … --json") from None

    def differences(self, entries: Sequence[Any]) -> list[str]:
        """Differences of new results from the stored ones, a line each; none if they are the same."""
        if len(entries) != len(self.entries):
            return [f"{len(self.entries)} results then, {len(entries)} now"]
        lines = []
        for old, new in zip(self.entries, json.loads(dumps(entries)), strict=True):
            pairs: list[Any] = [(str(old.get("trace")), _COMPARED, old, new)]
            rules = {each.get("name"): each for each in new.get("requirements", [])}
            named = [(str(each.get("name")), each) for each in old.get("requirements", [])]
            pairs += [(name, _EACH, each, rules.get(name, {})) for name, each in named]
            lines += [
                f"{name}: {key} {json.dumps(then.get(key))} then, {json.dumps(now.get(key))} now"
                for name, keys, then, now in pairs
                for key in keys
                if then.get(key) != now.get(key)
            ]
        return lines


def _result(path: Path) -> Mapping[str, Any]:
    try:
        if not path.is_file() or path.stat().st_size > MAX_BYTES:
            raise OSError("it is no file, or too large")
        found = json.loads(path.read_bytes())
        result = found["result"]
        if not isinstance(result, dict) or not isinstance(result.get("files", []), list):
            raise TypeError("its result is no record")
    except OSError as error:
        raise usage(f"`{path}` cannot be read: {error}", code="U102") from None
    except (ValueError, TypeError, LookupError, RecursionError) as error:
        message = f"`{path}` is no output of `stlc check --json`: {error}"
        raise usage(message, "stlc check SPEC TRACE --json > RESULT.json") from None
    return result
