"""The C library keeps freed memory."""

import platform

import pytest

from rhmc import portable


class Library:
    """A C library that notes what it is told."""

    def __init__(self) -> None:
        self.told: dict[int, int] = {}

    def mallopt(self, parameter: int, value: int) -> int:
        self.told[parameter] = value
        return 1


@pytest.mark.parametrize(("name", "told"), [("glibc", {-1: 1 << 30, -3: 1 << 30}), ("", {})])
def test_only_glibc_is_told_to_keep_freed_memory(
    name: str, told: dict[int, int], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Both thresholds: the first alone would stop glibc from raising the second."""
    library = Library()
    monkeypatch.setattr(portable.ctypes, "CDLL", lambda path: library)
    monkeypatch.setattr(platform, "libc_ver", lambda: (name, ""))
    portable.keep_memory()
    assert library.told == told
