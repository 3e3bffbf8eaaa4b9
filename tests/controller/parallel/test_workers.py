"""Calls in worker processes, some of which are lost."""

from __future__ import annotations

import os
import signal
import time
from pathlib import Path

import pytest

from stlc.controller.parallel import workers_of
from stlc.controller.parallel.workers import ATTEMPTS, CallError, LocalProcesses, LostCall, end_in_words


def square(number: int) -> int:
    return number * number


def fragile(job: tuple[str, int, int]) -> int:
    """Return a number; before that, be killed as often as told."""
    folder, number, kills = job
    marks = Path(folder) / str(number)
    marks.mkdir(exist_ok=True)
    tried = len(list(marks.iterdir()))
    (marks / str(tried)).touch()
    if tried < kills:
        os.kill(os.getpid(), signal.SIGKILL)
    return number


def refuse(number: int) -> int:
    if number == 2:
        raise KeyError("two is refused")
    return number


def leave(_: int) -> None:
    os._exit(7)


def own_process(_: int) -> int:
    time.sleep(0.02)
    return os.getpid()


def test_every_argument_has_a_result() -> None:
    with LocalProcesses(2) as workers:
        for count in (0, 1, 9):  # the same processes again
            found = {each.index: each.value for each in workers.results(square, range(count))}
            assert found == {number: number * number for number in range(count)}


def test_as_many_processes_as_are_asked_for() -> None:
    with LocalProcesses(3) as workers:
        processes = {each.value for each in workers.results(own_process, range(12))}
        assert len(processes) == 3
        assert os.getpid() not in processes
    for process in processes:
        with pytest.raises(ProcessLookupError):
            os.kill(process, 0)


def test_a_lost_worker_costs_its_own_call_only(tmp_path: Path) -> None:
    jobs = [(str(tmp_path), number, {3: 2, 5: 9}.get(number, 0)) for number in range(12)]
    with LocalProcesses(2) as workers:
        found = {each.index: each.value for each in workers.results(fragile, jobs)}
    lost = found.pop(5)
    assert found == {number: number for number in range(12) if number != 5}
    assert lost == LostCall(end_in_words(-signal.SIGKILL), ATTEMPTS)
    tries = {path.name: len(list(path.iterdir())) for path in tmp_path.iterdir()}
    assert tries == {str(number): {3: 3, 5: ATTEMPTS}.get(number, 1) for number in range(12)}


def test_a_call_may_be_made_once_only(tmp_path: Path) -> None:
    with LocalProcesses(1) as workers:
        (ended,) = workers.results(fragile, [(str(tmp_path), 0, 1)], attempts=1)
    assert ended.value == LostCall(end_in_words(-9), 1)


def test_how_a_process_ended_is_said() -> None:
    with LocalProcesses(1) as workers:
        (ended,) = workers.results(leave, [0])
    assert ended.value == LostCall("its process ended with exit code 7", ATTEMPTS)
    assert "SIGKILL, as the system does for lack of memory" in end_in_words(-9)
    assert end_in_words(-signal.SIGSEGV) == "its process was ended by SIGSEGV"
    assert end_in_words(-99) == "its process was ended by signal 99"


def test_what_a_function_raises_is_raised_here() -> None:
    with (
        pytest.raises(KeyError, match="two is refused") as caught,
        LocalProcesses(2) as workers,
    ):
        list(workers.results(refuse, range(5)))
    assert isinstance(caught.value.__cause__, CallError)
    assert "in refuse" in str(caught.value.__cause__)


def test_arguments_are_taken_as_workers_become_free() -> None:
    taken = []

    def arguments():
        for number in range(50):
            taken.append(number)
            yield number

    with LocalProcesses(2) as workers:
        ended = workers.results(square, arguments())
        next(ended)
        assert len(taken) <= 3


def test_processes_with_an_empty_interpreter() -> None:
    with workers_of(1, fresh=True) as workers:
        (ended,) = workers.results(square, [4])
    assert ended.value == 16
