"""Several processes that train together, forked from the one that tests: nothing is imported again."""

from __future__ import annotations

import multiprocessing
import os
import socket
import traceback
from collections.abc import Callable
from typing import Any

import torch

from stlc.controller.parallel.ddp import Ranks, joined

ENVIRONMENT = {"WORLD_SIZE": 2, "LOCAL_WORLD_SIZE": 2, "MASTER_ADDR": "127.0.0.1"}
"""Environment that `torchrun` gives each of two ranks."""
SECONDS = 60


def free_port() -> int:
    """A port that nobody listens at."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port: int = probe.getsockname()[1]
    return port


def together(work: Callable[[Ranks], Any]) -> list[Any]:
    """Results of `work` on each of two ranks: its value, or the exception; None of one that died."""
    fork = multiprocessing.get_context("fork")
    port = free_port()
    answers = [fork.Pipe(duplex=False) for _ in range(2)]
    processes = [
        fork.Process(target=_one, args=(rank, port, work, end)) for rank, (_, end) in enumerate(answers)
    ]
    for process, (_, end) in zip(processes, answers, strict=True):
        process.start()
        end.close()
    return [_answer(process, receiver) for process, (receiver, _) in zip(processes, answers, strict=True)]


def _one(rank: int, port: int, work: Callable[[Ranks], Any], end: Any) -> None:
    torch.set_num_threads(1)
    told = {**ENVIRONMENT, "RANK": rank, "LOCAL_RANK": rank, "MASTER_PORT": port}
    os.environ.update({name: str(value) for name, value in told.items()})
    try:
        with joined("cpu") as ranks:
            answer = work(ranks)
    except Exception as error:
        traceback.print_exc()
        answer = error
    end.send(answer)


def _answer(process: Any, receiver: Any) -> Any:
    try:
        assert receiver.poll(SECONDS), "a rank hangs"
        return receiver.recv()
    except EOFError:
        return None
    finally:
        if process.is_alive():
            process.join(1.0)
            process.kill()
        process.join()
