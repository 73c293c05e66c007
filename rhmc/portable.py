"""Settings under which torch computes the same bytes on every x86-64 processor with AVX2 and FMA.

torch and the libraries below it choose instructions by the processor that they find, and other instructions round
otherwise. Here they are told to use those that all such processors have; products of layers are those of
`rhmc.networks.linear`, which need no setting. `Tensor.sqrt` is left out of `rhmc`: MKL's differs all the same. They
read the settings at their first operation, so importing `rhmc` before anything is computed is enough. What was
compared, and where: `docs/reproducibility.md`.
"""

import ctypes
import os
import platform
from pathlib import Path

SETTINGS = {
    "ATEN_CPU_CAPABILITY": "avx2",  # torch's own kernels: exp, tanh, softmax
    "MKL_CBWR": "COMPATIBLE",  # functions of arrays, and products of matrices outside `rhmc.networks.linear`
    "ONEDNN_DEFAULT_FPMATH_MODE": "STRICT",  # products of `rhmc.networks.linear`: no numbers of fewer bits
}
CAPABILITY = "AVX2"  # what torch then says of itself
X86 = platform.machine().lower() in {"x86_64", "amd64"}
CPUINFO = Path("/proc/cpuinfo")
KEPT = 1 << 30  # bytes of freed memory that a process keeps for its next tensors
ALLOCATOR = {-1: KEPT, -3: KEPT}  # M_TRIM_THRESHOLD and M_MMAP_THRESHOLD of malloc.h


def apply() -> None:
    """Put the settings into the environment, in place of what is there: a run's name stands for its bytes."""
    if possible():
        os.environ.update(SETTINGS)


def keep_memory() -> None:
    """Let glibc keep freed memory, of which the kernel would clear each page anew. It changes no result."""
    if platform.libc_ver()[0] == "glibc":
        libc = ctypes.CDLL(None)
        for parameter, value in ALLOCATOR.items():
            libc.mallopt(parameter, value)


def possible() -> bool:
    """True if this processor has the instructions; results of another kind are its own."""
    if not X86:
        return False
    return not CPUINFO.exists() or {"avx2", "fma"} <= set(CPUINFO.read_text(encoding="utf-8").split())


def active() -> bool:
    """True if torch follows the settings; not if it computed something before they were made."""
    import torch

    return not possible() or torch.backends.cpu.get_cpu_capability() == CAPABILITY
