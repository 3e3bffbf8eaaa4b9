from __future__ import annotations

import errno
import json
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

import stlc.rundir
from stlc.diagnostics import MissingError, RunError, StlcError, UsageError
from stlc.rundir import RunDir


@pytest.fixture
def root(tmp_path: Path) -> Path:
    return tmp_path / "runs"


def made(root: Path, spec: str, words: str) -> RunDir:
    run = RunDir.create(root, spec, words)
    run.update({"status": "running"})
    return run


# ---------------------------------------------------------------------- making


def test_one_process_at_a_time_trains_a_run(root, monkeypatch):
    run = made(root, "traffic", "quiet-heron")
    with run.claimed() as first, run.claimed() as second:
        assert (first, second) == (True, False)
        with RunDir.create(root, "traffic").claimed() as other:
            assert other
        assert [path.name for path in run.path.iterdir()] == ["run.json"]
        monkeypatch.setitem(sys.modules, "fcntl", None)  # as on Windows
        with run.claimed() as unguarded:
            assert unguarded


def test_a_claim_ends_with_its_process(root):
    run = made(root, "traffic", "quiet-heron")
    script = f"""
from pathlib import Path
from stlc.rundir import RunDir
with RunDir(Path({str(run.path)!r})).claimed() as own:
    print(own, flush=True)
    input()
"""
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE}
    with subprocess.Popen([sys.executable, "-c", script], **pipes) as process:
        assert process.stdout.readline() == b"True\n"
        with run.claimed() as own:
            assert not own
        process.kill()
    with run.claimed() as own:
        assert own


def test_numbers_count_per_spec(root):
    names = [RunDir.create(root, spec, "quiet-heron").path for spec in ("traffic", "traffic", "patrol")]
    assert [path.relative_to(root).as_posix() for path in names] == [
        "traffic/0001-quiet-heron",
        "traffic/0002-quiet-heron",
        "patrol/0001-quiet-heron",
    ]


def test_a_removed_run_does_not_make_its_successors_number_free(root):
    first, second = (RunDir.create(root, "traffic") for _ in range(2))
    first.path.rmdir()
    assert RunDir.create(root, "traffic").name.startswith("0003-")
    assert second.path.is_dir()


def test_words_are_drawn(root):
    names = {RunDir.create(root, "traffic").name.partition("-")[2] for _ in range(20)}
    assert len(names) > 10
    assert all(len(name.split("-")) == 2 for name in names)


def test_no_number_is_given_twice_to_many_at_once(root):
    with ThreadPoolExecutor(8) as pool:
        runs = list(pool.map(lambda _: RunDir.create(root, "traffic"), range(64)))
    numbers = sorted(int(run.name[:4]) for run in runs)
    assert len(set(numbers)) == 64
    assert not list(root.glob("traffic/.*"))


def test_the_marker_of_a_killed_process_costs_one_number(root):
    (root / "traffic" / ".0001").mkdir(parents=True)
    assert RunDir.create(root, "traffic").name.startswith("0002-")


@pytest.mark.parametrize("words", ["", "a/b", "..", "latest", "two words"])
def test_words_that_cannot_be_a_folder_are_refused(root, words):
    with pytest.raises(UsageError, match="cannot name a run"):
        RunDir.create(root, "traffic", words)


def test_a_spec_name_cannot_leave_the_root(root):
    run = RunDir.create(root, "../../etc")
    assert run.path.parent.parent == root


def test_a_spec_may_be_called_as_the_link(root):
    first = made(root, "traffic", "quiet-heron")
    for name in ("latest", "Latest"):
        run = made(root, name, "bold-fox")
        assert run.path.resolve().parent.parent == root.resolve()
        assert RunDir.newest(root).path == run.path.resolve()
    assert [path.name for path in first.path.iterdir()] == ["run.json"]


def test_an_unwritable_root_is_the_environments_fault(root, monkeypatch):
    def full(*_arguments, **_options):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(Path, "mkdir", full)
    with pytest.raises(MissingError, match="no space left on device"):
        RunDir.create(root, "traffic")


# ---------------------------------------------------------------------- links


def test_links_point_at_the_newest(root):
    for spec in ("traffic", "patrol", "traffic"):
        newest = made(root, spec, "calm-seal")
        assert (root / "latest").resolve() == newest.path
        assert (root / spec / "latest").resolve() == newest.path
    assert (root / "latest").readlink() == Path("traffic/0002-calm-seal")


def test_newest_without_a_link(root, monkeypatch):
    monkeypatch.setattr(stlc.rundir, "_point", lambda *_: None)
    made(root, "traffic", "a-a")
    last = made(root, "traffic", "b-b")
    assert RunDir.newest(root) == last


def test_newest_of_nothing_says_what_to_do(root):
    with pytest.raises(UsageError) as caught:
        RunDir.newest(root)
    (finding,) = caught.value.diagnostics
    assert finding.code == "R101"
    assert "stlc train" in finding.help[0]


# ---------------------------------------------------------------------- opening


@pytest.mark.parametrize(
    "where",
    ["latest", "patrol", "patrol/2", "2", "0002", "grey-wolf", "0002-grey-wolf", "patrol/0002-grey-wolf"],
)
def test_a_run_has_many_names(root, where):
    made(root, "traffic", "red-fox")
    made(root, "patrol", "tall-swan")
    wanted = made(root, "patrol", "grey-wolf")
    assert RunDir.open(where, root).path == wanted.path


def test_a_run_is_found_by_any_path_into_it(root, monkeypatch):
    run = made(root, "traffic", "red-fox")
    (run.path / "ckpt").mkdir()
    for where in (run.path, str(run.path), run.path / "run.json", run.path / "ckpt"):
        assert RunDir.open(where, root).path == run.path
    monkeypatch.chdir(root.parent)
    assert RunDir.open("runs/latest", root).path == run.path


def test_a_specification_file_names_its_newest_run(root, tmp_path):
    path, other = tmp_path / "mine.stl", tmp_path / "traffic.stl"
    path.touch()
    other.touch()
    made(root, "named_otherwise", "a-a").update({"spec_path": str(path)})
    newest = made(root, "named_otherwise", "b-b")
    newest.update({"spec_path": str(path)})
    traffic = made(root, "traffic", "c-c")
    assert RunDir.open(path, root).path == newest.path
    assert RunDir.open(other, root).path == traffic.path
    (traffic.path / "spec.stl").touch()
    assert RunDir.open(traffic.path / "spec.stl", root).path == traffic.path
    (tmp_path / "none.stl").touch()
    with pytest.raises(UsageError) as caught:
        RunDir.open(tmp_path / "none.stl", root)
    assert "stlc train" in caught.value.diagnostics[0].help[0]


def test_an_ambiguous_name_lists_its_runs(root):
    made(root, "traffic", "red-fox")
    made(root, "patrol", "tall-swan")
    with pytest.raises(UsageError) as caught:
        RunDir.open("1", root)
    assert caught.value.diagnostics[0].help == ("patrol/0001-tall-swan", "traffic/0001-red-fox")


def test_a_slip_gets_a_hint(root):
    made(root, "traffic", "red-fox")
    with pytest.raises(UsageError) as caught:
        RunDir.open("red-fux", root)
    assert caught.value.diagnostics[0].help == ("did you mean `red-fox`?",)


@pytest.mark.parametrize("text", ["", "{", "[]", "\udcff"])
def test_a_damaged_record_is_a_diagnostic(root, text):
    run = made(root, "traffic", "red-fox")
    (run.path / "run.json").write_bytes(text.encode("utf-8", "surrogateescape"))
    with pytest.raises(RunError) as caught:
        RunDir.open(run.path, root)
    assert caught.value.diagnostics[0].code == "R101"
    assert caught.value.exit_code == 3


def test_a_folder_without_a_record_is_no_run(tmp_path):
    with pytest.raises(RunError, match=r"it has no run\.json"):
        RunDir.open(tmp_path)


def test_runs_are_in_the_order_of_their_numbers(root):
    for name in ("10000-b", "9999-a", "0010-c"):
        RunDir(root / "traffic" / name).write_json("run.json", {})
    assert [run.name for run in RunDir.every(root)] == ["0010-c", "9999-a", "10000-b"]
    assert RunDir.open("traffic", root).name == "10000-b"


def test_only_runs_are_listed(root):
    run = made(root, "traffic", "red-fox")
    (root / "traffic" / "notes").mkdir()
    RunDir.create(root, "traffic")
    assert RunDir.every(root) == [run]


# ---------------------------------------------------------------------- records


def test_the_record_grows(root):
    run = RunDir.create(root, "traffic")
    run.update({"seed": 3, "status": "running"})
    assert run.status == "running"
    run.finish("finished", {"spread": float("nan")})
    record = run.record()
    assert record["seed"] == 3
    assert record["status"] == run.status == "finished"
    assert record["result"] == {"spread": "nan"}
    assert record["finished"].endswith("+00:00")


def test_a_failed_write_leaves_the_old_record(root, monkeypatch):
    run = made(root, "traffic", "red-fox")

    def full(*_arguments):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(Path, "write_bytes", full)
    with pytest.raises(MissingError):
        run.update({"seed": 1})
    monkeypatch.undo()
    assert run.record() == {"status": "running"}
    assert sorted(path.name for path in run.path.iterdir()) == ["run.json"]


# ---------------------------------------------------------------------- rows


def test_rows_come_back(root):
    run = RunDir.create(root, "traffic")
    assert run.rows() == []
    for step in range(3):
        run.append_row({"step": step, "loss": 0.5})
    assert [row["step"] for row in run.rows()] == [0, 1, 2]


@pytest.mark.parametrize("cut", range(1, 24))
def test_a_kill_in_the_middle_of_a_row_costs_that_row(root, cut):
    run = RunDir.create(root, "traffic")
    run.append_row({"step": 1})
    run.append_row({"step": 2, "loss": 0.25})
    file = run.path / "train.jsonl"
    file.write_bytes(file.read_bytes()[:-cut])
    assert [row["step"] for row in run.rows()] == [1]
    run.append_row({"step": 3})
    assert [row["step"] for row in run.rows()] == [1, 3]


def test_a_row_that_is_not_json_is_a_diagnostic(root):
    run = RunDir.create(root, "traffic")
    (run.path / "train.jsonl").write_text('{"step": 1}\nnonsense\n')
    with pytest.raises(RunError, match=r"train\.jsonl`, line 2, is damaged"):
        run.rows()


def test_a_resumed_run_drops_the_rows_past_its_checkpoint(root):
    run = RunDir.create(root, "traffic")
    for step in range(5):
        run.append_row({"step": step})
    run.keep_rows(lambda row: row["step"] <= 2)
    run.append_row({"step": 3, "again": True})
    assert [row["step"] for row in run.rows()] == [0, 1, 2, 3]
    assert json.loads((run.path / "train.jsonl").read_text().splitlines()[-1]) == {"step": 3, "again": True}


def test_every_error_carries_a_known_code(root):
    for action in (
        lambda: RunDir.newest(root),
        lambda: RunDir.open("x", root),
        lambda: RunDir(root).record(),
    ):
        with pytest.raises(StlcError) as caught:
            action()
        assert [finding.code for finding in caught.value.diagnostics] == ["R101"]


# ---------------------------------------------------------------------- runs of strangers


def test_links_in_a_run_are_not_read(root, tmp_path):
    run = made(root, "traffic", "quiet-heron")
    (tmp_path / "far.json").write_text('{"secret": 1}')
    (run.path / "train.jsonl").symlink_to(tmp_path / "far.json")
    (run.path / "eval").symlink_to(tmp_path)
    for read in (run.rows, lambda: run.read_json("eval/far.json"), lambda: run.source("eval/far.json")):
        with pytest.raises(RunError, match=r"R110.*it is a link"):
            read()
    (run.path / "run.json").unlink()
    (run.path / "run.json").symlink_to("/dev/zero")
    with pytest.raises(RunError, match="R110"):
        run.record()


def test_a_row_is_appended_beside_what_a_link_leads_to(root, tmp_path):
    run = made(root, "traffic", "quiet-heron")
    (tmp_path / "keys").write_text("mine\n")
    (run.path / "train.jsonl").symlink_to(tmp_path / "keys")
    run.append_row({"step": 1})
    assert run.rows() == [{"step": 1}]
    assert (tmp_path / "keys").read_text() == "mine\n"


def test_latest_leads_to_a_run_below_its_folder_alone(root, tmp_path):
    run = made(root, "traffic", "quiet-heron")
    assert RunDir.open("latest", root).path == RunDir.open(root / "latest").path == run.path
    far = made(tmp_path / "elsewhere", "traffic", "far-fox")
    (root / "latest").unlink()
    (root / "latest").symlink_to(far.path)
    (root / "linked").symlink_to(far.path.parent)
    for where in ("latest", root / "latest"):
        with pytest.raises(RunError, match=r"R110.*leads out of its folder"):
            RunDir.found(where, root)
    assert [each.path for each in RunDir.every(root)] == [run.path]
    with pytest.raises(UsageError):
        RunDir.found("far-fox", root)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ('{"result": {"accuracy": "high"}}', "`result.accuracy` is 'high', not a number"),
        ('{"result": {"interval": [0.1]}}', "`result.interval` is [0.1], not a list of 2"),
        ('{"hardware": {"cores": []}}', "`hardware.cores` is [], not a whole number"),
        ('{"seed": 1e999}', "`seed` is not finite"),
        ("[" * 9000, "nested too deeply"),
    ],
)
def test_a_damaged_record_is_said_with_file_and_key(root, text, said):
    run = made(root, "traffic", "quiet-heron")
    (run.path / "run.json").write_text(text)
    with pytest.raises(RunError) as caught:
        run.record()
    (finding,) = caught.value.diagnostics
    assert "run.json` is damaged" in finding.message
    assert said in finding.note[0]
