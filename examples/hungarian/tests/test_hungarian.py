"""RHMC with the coordinator Hungarian does what every method has to do."""

import hungarian.coordinator  # noqa: F401  # registers itself

from pipelines.conformance.methods import check_method


def test_it_conforms() -> None:
    assert [(one.check, one.fault) for one in check_method("rhmc", {}, 12_000, "hungarian") if one.fault] == []
