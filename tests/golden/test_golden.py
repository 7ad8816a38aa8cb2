"""No answer has changed since it was frozen; ``compare.py`` prints differences, and freezes new answers."""

from __future__ import annotations

import golden
import pytest
from cases import CASES

pytestmark = pytest.mark.skipif(
    not golden.ANSWERS.exists(), reason="the source distribution contains no frozen answers"
)


@pytest.fixture(scope="module")
def frozen():
    return golden.load()


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("golden")


@pytest.mark.parametrize("name", CASES)
def test_answers_are_as_they_were(name, frozen, folder, monkeypatch):
    monkeypatch.chdir(folder)
    assert name in frozen, "never frozen: python tests/golden/compare.py --freeze"
    wrong = golden.differences(name, golden.answers(name), frozen[name])
    assert not wrong


def test_every_frozen_answer_has_a_case(frozen):
    assert set(frozen) == set(CASES)
