"""Fail unless the installed torch is a CPU build and no CUDA package is there. Imports nothing but the library."""

import runpy
import sys
from importlib.metadata import distribution, distributions

HELP = """\
The pinned results come from torch's CPU build, and this machine's package index gave one for CUDA. To get the CPU one:
  1. on pytorch.org, choose the stable release, pip and CPU; the command shown there names the index with CPU builds;
  2. remove .venv, and hand that option to make:  make setup PIP_TORCH_ARGS="--index-url <that index>"
(A wheel at hand works too: PIP_TORCH_ARGS="--find-links <folder with the wheel>".)"""


def faults() -> list[str]:
    """What is wrong with the environment, one line each."""
    cuda = runpy.run_path(str(distribution("torch").locate_file("torch/version.py")))["cuda"]
    names = sorted({d.metadata["Name"] for d in distributions()})
    extra = [n for n in names if n.lower().startswith(("nvidia-", "cuda-")) or n.lower() == "triton"]
    build = [f"torch {distribution('torch').version} is built for CUDA {cuda}"] if cuda else []
    return build + [f"installed: {name}" for name in extra]


if __name__ == "__main__":
    found = faults()
    if found:
        sys.exit("\n".join([*found, "", HELP]))
