"""The results are those of before, to the last bit."""

import ast
import os
import subprocess
import sys

import pytest

from pipelines.workspace.arithmetic import PUBLISHED, operations
from rhmc.portable import SETTINGS, active
from tests.golden import cases, kept

CASES = cases()
HERE = operations()
OTHERS = [name for name, published in PUBLISHED.items() if HERE[name] != published]
# On such a processor no digest can say whether the code is right; `rhmc doctor` names the operations to a user.
published = pytest.mark.skipif(
    bool(OTHERS), reason=f"this machine computes otherwise: {', '.join(OTHERS)} (docs/reproducibility.md)"
)


@published
@pytest.mark.parametrize("name", CASES)
def test_golden(name: str) -> None:
    found = CASES[name]()
    if found != kept().get(name):
        todo = "if it is meant to, `python -m tests.golden --write`, and say so in the changelog"
        pytest.fail(f"{name}: {found} instead of {kept().get(name)}; the code changes results: {todo}")


def test_every_golden_digest_is_looked_at() -> None:
    assert set(kept()) == set(CASES)


@published
def test_operations_give_the_published_bytes() -> None:
    assert active()
    assert HERE == PUBLISHED


@pytest.mark.parametrize("least", ["AVX2", "AVX512_CORE"])
def test_wider_instructions_of_layers_give_the_same_bytes(least: str) -> None:
    """oneDNN takes the widest instructions that it is allowed; a processor without these takes the others."""
    assert elsewhere("import rhmc", ["layers"], os.environ | {"ONEDNN_MAX_CPU_ISA": least}) == {
        "layers": HERE["layers"]
    }


def elsewhere(way: str, groups: list[str], environment: dict[str, str]) -> dict[str, str]:
    """The digests of some groups of operations in a fresh process, which has come into the program by a way."""
    program = f"{way}\nfrom pipelines.workspace.arithmetic import operations\nprint(operations({groups!r}))"
    command = [sys.executable, "-c", program]
    said = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
    found: dict[str, str] = ast.literal_eval(said.stdout.strip().splitlines()[-1])
    return found


# Ways into the program: each has to settle the arithmetic before anything is computed.
WAYS = {
    "torch first": "import torch\nimport rhmc",
    "the science": "from rhmc.training.trainer import Trainer",
    "studies": "from pipelines.specs.study import Study",
    "a worker": "from pipelines.execution.trainable import RunTrainable",
    "a model of MLflow": "from pipelines.tracking.mlflow_model import ServedPolicy",
    "command line": "import pipelines.cli.main\nfrom pipelines.policies.evaluation import score",
    "benchmark": "import sys\nsys.path.insert(0, 'benchmarks')\nimport train_speed",
    "golden": "import tests.golden",
}
# Each setting is read by one of these: torch's own functions, MKL's products, oneDNN's layers. The others take longer.
TELLING = ["transcendental", "products of matrices", "layers"]
HOSTILE = dict.fromkeys(SETTINGS, "default") | {"MKL_CBWR": "AVX2", "ONEDNN_DEFAULT_FPMATH_MODE": "BF16"}


@pytest.mark.parametrize("way", WAYS)
def test_the_arithmetic_is_settled_however_one_comes_in(way: str) -> None:
    """Also where somebody has set something else before."""
    found = elsewhere(WAYS[way], TELLING, HOSTILE | {"PATH": "/usr/bin:/bin"})
    assert found == {name: HERE[name] for name in TELLING}
