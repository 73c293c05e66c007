"""What the tests of the process pool have done in processes. Each of them imports this: it imports little."""

import os
import signal
import time
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

import torch

Given = TypeVar("Given")
Made = TypeVar("Made")


def told(item: int) -> tuple[int, int, int]:
    """The item, who worked on it and with how many threads."""
    return item, os.getpid(), torch.get_num_threads()


def first_after_last(item: tuple[int, Path]) -> tuple[int, int, int]:
    """The same; the first item, 0, waits for the last one, 4, which leaves a file behind."""
    number, file = item
    while number == 0 and not file.exists():
        time.sleep(0.01)
    if number == 4:
        file.touch()
    return told(number)


def sleepy(item: tuple[float, bytes]) -> int:
    """Sleeps for some seconds and says how large the rest was."""
    time.sleep(item[0])
    return len(item[1])


def faulty(item: Exception | int) -> int:
    """Raises what can be raised."""
    if isinstance(item, Exception):
        raise item
    return item


def shared(tensor: torch.Tensor) -> tuple[bool, torch.Tensor]:
    """True if the tensor came in shared memory, and the next one."""
    return tensor.is_shared(), tensor + 1


def die(item: object) -> None:
    """Dies, as for want of memory."""
    os.kill(os.getpid(), signal.SIGKILL)


def killed(item: int) -> int:
    """Dies, if it is the second."""
    if item == 1:
        die(item)
    return item


def marked(function: Callable[[Given], Made], folder: str, item: Given) -> Made:
    """The function's result; first a file in the folder has this process's number for a name."""
    (Path(folder) / str(os.getpid())).touch()
    return function(item)
