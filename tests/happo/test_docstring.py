"""The examples in docstrings run and give what they show."""

from __future__ import annotations

import doctest

import pytest

from marl_explore.happo import loss


@pytest.mark.parametrize(
    "test", [t for t in doctest.DocTestFinder().find(loss) if t.examples], ids=lambda t: t.name
)
def test_an_example(test):
    runner = doctest.DocTestRunner()
    report: list[str] = []
    runner.run(test, out=report.append)
    assert not runner.failures, "".join(report)


def test_the_loss_has_an_example():
    (example,) = (t for t in doctest.DocTestFinder().find(loss.HAPPOLoss, "it") if t.examples)
    assert "update_factor" in example.docstring
