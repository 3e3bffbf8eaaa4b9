"""Calls on machines that see the caller's files, and on machines that do not."""

from __future__ import annotations

import json
import shutil
from dataclasses import dataclass, replace
from pathlib import Path

import pytest

from stlc.controller.parallel.elsewhere import RemoteCall, answer, linked, translated
from stlc.controller.parallel.workers import CallFiles
from stlc.diagnostics import MissingError, RunError


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
    return RemoteCall.of(copied, order, CallFiles(tuple(map(Path, names)), (order.out,)), {})


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


def test_files_of_every_call_are_where_the_worker_is(
    call: RemoteCall, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    sent = tmp_path / "sent"
    sent.mkdir()
    names = linked([tmp_path / "home/logs"], sent)  # a folder: of its files each
    assert {path.name: path.read_text() for path in sent.iterdir()} == {"0": "near "}
    inputs = (Path("logs"), tmp_path / "b.txt")
    near = RemoteCall.of(copied, call.argument, CallFiles(inputs, tuple(map(Path, call.outputs))), names)
    assert near.others == [tmp_path / "b.txt"]
    shutil.copytree(sent, tmp_path / "working_dir")
    far = near.with_files()
    assert far.sent == {str(tmp_path / "b.txt"): b"far"}
    (tmp_path / "b.txt").write_text("changed since")
    monkeypatch.chdir(tmp_path / "working_dir")
    assert answer(near).missing
    found = answer(far).delivered()
    assert found == {"from": str(tmp_path / "home"), "logs/a.txt": "near ", str(tmp_path / "b.txt"): "far"}
    assert (tmp_path / "out/both.txt").read_text() == "near far"
    assert sorted(path.name for path in Path().iterdir()) == ["0"]


def written(folder: Path) -> Path:
    (folder / "deep").mkdir(parents=True)
    (folder / "deep/a.json").write_text(json.dumps({"path": str(folder / "x")}))
    (folder / "deep/a.bin").write_bytes(str(folder).encode())
    (folder / "link").symlink_to("/etc")
    (folder / "deep/link.json").symlink_to("/etc/hostname")
    return folder / "deep"


def test_a_folder_comes_back(tmp_path: Path) -> None:
    folder = tmp_path / "out"
    call = RemoteCall.of(written, folder, CallFiles((), (folder,)), {})
    back = answer(replace(call, folder="/not/here"))
    assert back.value == folder / "deep"
    assert back.outputs is not None
    assert sorted(back.outputs) == [str(folder / "deep/a.bin"), str(folder / "deep/a.json")]
    assert json.loads(back.outputs[str(folder / "deep/a.json")]) == {"path": str(folder / "x")}
    assert back.outputs[str(folder / "deep/a.bin")].decode().endswith(str(folder))  # as it was written
    assert not folder.exists()


def test_a_link_in_a_folder_is_not_sent(tmp_path: Path) -> None:
    (tmp_path / "run").mkdir()
    (tmp_path / "run/a.json").symlink_to("/etc/hostname")
    with pytest.raises(RunError, match="R110"):
        linked([tmp_path / "run"], tmp_path)


def test_another_version_is_refused(call: RemoteCall) -> None:
    refused = answer(replace(call, version="0.0.0"))
    with pytest.raises(MissingError, match=r"R406.*0\.0\.0 is needed"):
        refused.delivered()


def test_texts_and_paths_are_translated_wherever_they_are() -> None:
    value = {"a": [Path("/x/y"), "/x/y", 3], "b": (Order(("/x/y", "z"), Path("/x/o")),)}
    found = translated(value, lambda text: str(text).replace("/x/", "/c/"))
    assert found == {"a": [Path("/c/y"), "/c/y", 3], "b": (Order(("/c/y", "z"), Path("/c/o")),)}
