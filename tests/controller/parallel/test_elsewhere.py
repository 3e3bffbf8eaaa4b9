"""Calls on machines that see the caller's files, and on machines that do not."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import pytest

from stlc.controller.parallel.elsewhere import RemoteCall, answer, translated
from stlc.controller.parallel.workers import CallFiles
from stlc.diagnostics import MissingError


@dataclass(frozen=True)
class Order:
    """Action that `copied` performs."""

    names: tuple[str, ...]
    out: Path


def copied(order: Order) -> dict[str, str]:
    texts = {name: Path(name).read_text() for name in order.names}
    order.out.parent.mkdir(parents=True, exist_ok=True)
    order.out.write_text("".join(texts.values()))
    return {"from": str(Path.cwd()), **texts}


@pytest.fixture
def call(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> RemoteCall:
    home = tmp_path / "home"
    (home / "logs").mkdir(parents=True)
    (home / "logs/a.txt").write_text("near ")
    (tmp_path / "b.txt").write_text("far")
    monkeypatch.chdir(home)
    names = ("logs/a.txt", str(tmp_path / "b.txt"))
    order = Order(names, tmp_path / "out/both.txt")
    return RemoteCall.of(copied, order, CallFiles(tuple(map(Path, names)), (order.out,)))


def test_a_machine_that_sees_the_files(
    call: RemoteCall, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir("/")
    found = answer(call).delivered()
    assert found == {"from": str(tmp_path / "home"), "logs/a.txt": "near ", str(tmp_path / "b.txt"): "far"}
    assert (tmp_path / "out/both.txt").read_text() == "near far"
    assert Path.cwd() == Path("/")


def test_a_machine_that_does_not_asks_for_them(call: RemoteCall, tmp_path: Path) -> None:
    far = call.with_files()
    (tmp_path / "home/logs/a.txt").write_text("another text")
    assert not call.shared
    assert answer(call).missing
    found = answer(far).delivered()
    assert found == {"from": str(tmp_path / "home"), "logs/a.txt": "near ", str(tmp_path / "b.txt"): "far"}
    assert (tmp_path / "out/both.txt").read_text() == "near far"


def test_another_version_is_refused(call: RemoteCall) -> None:
    with pytest.raises(MissingError, match=r"R406.*0\.0\.0 is needed"):
        answer(replace(call, version="0.0.0"))


def test_texts_and_paths_are_translated_wherever_they_are() -> None:
    value = {"a": [Path("/x/y"), "/x/y", 3], "b": (Order(("/x/y", "z"), Path("/x/o")),)}
    found = translated(value, lambda text: str(text).replace("/x/", "/c/"))
    assert found == {"a": [Path("/c/y"), "/c/y", 3], "b": (Order(("/c/y", "z"), Path("/c/o")),)}
