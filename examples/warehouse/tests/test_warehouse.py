"""The task Warehouse does what every task has to do, and every method that fits trains in it."""

import warehouse.task

from pipelines.conformance.tasks import check_task


def test_it_conforms() -> None:
    kind = warehouse.task.Config().kind
    assert [(one.check, one.fault) for one in check_task(kind, {}) if one.fault] == []
