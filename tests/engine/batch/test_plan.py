"""A plan's key depends on everything that changes results, and on nothing else."""

import json
import pickle
from pathlib import Path

import numpy as np
import pytest

from mirrorskin import io
from mirrorskin.engine.batch import jobs as plans
from mirrorskin.engine.batch.jobs import Plan


@pytest.mark.parametrize(
    ("first", "other"),
    [
        (Plan(press={"threshold": 0.5}), Plan()),
        (Plan(press={"hold": 3, "fill": False}), Plan(press={"fill": False, "hold": 3})),
        (Plan(memory_limit=1000), Plan()),
        (Plan(opening={"threads": 1}), Plan(opening={"threads": 2})),
        (Plan(opening={"dataset": None}), Plan()),
        (Plan(rotation={"tilt": 0.1}), Plan()),
        (Plan(opening={"phase": io.Steps(0.1), "tilt": 0.1}), Plan()),
    ],
)
def test_what_changes_no_press_changes_no_key_of_presses(first, other):
    assert first.key("vertical") == other.key("vertical")
    assert first.digest("vertical") == other.digest("vertical")


@pytest.mark.parametrize(
    "other",
    [
        Plan(press={"threshold": 0.4}),
        Plan(press={"dark": np.zeros((5, 7))}),
        Plan(press={"dark": np.ones((5, 7))}),
        Plan(opening={"travel": io.Steps(0.1)}),
        Plan(opening={"travel": io.Steps(0.1, 0.2)}),
        Plan(opening={"pixel_size": (0.1, 0.1)}),
        Plan(opening={"dataset": "/x"}),
        Plan(opening={"frames": (2, None)}),
    ],
)
def test_what_changes_a_press_changes_its_key(other):
    keys = {plan.key("vertical") for plan in (Plan(), Plan(press={"dark": 5.0}), other)}
    assert len(keys) == 3


def test_a_rotation_s_key_has_nothing_of_presses():
    assert Plan(press={"hold": 5}, opening={"travel": io.Steps(0.1)}).key("axial") == Plan().key("axial")
    assert Plan(rotation={"robust": True}).key("axial") != Plan().key("axial")
    assert Plan(opening={"tilt": 0.1}).key("axial") != Plan().key("axial")


def test_another_version_has_another_key(monkeypatch):
    before = Plan().key("vertical")
    monkeypatch.setattr(plans, "program_version", lambda: "99.0")
    assert Plan().key("vertical") != before


def test_a_key_is_json_that_includes_defaults_too():
    plan = Plan({"travel": io.Steps(0.1), "dataset": "/x", "file": Path("a")}, {"dark": np.float32(2)})
    key = json.loads(plan.key("vertical"))
    assert key["opening"] == {"dataset": "/x", "travel": {"Steps": {"start": 0.0, "step": 0.1}}, "file": "a"}
    assert (key["press"]["dark"], key["press"]["threshold"]) == (2.0, 0.5)
    assert "memory_limit" not in key["press"]


WEAR = """
from mirrorskin import engine

class Wear(engine.Operation):
    offset: float = engine.option(default=0.5, unit="mm", help="offset")
"""


def test_a_plan_with_a_user_s_operation_changes_with_its_options_and_its_code(tmp_path, monkeypatch):
    paths = [tmp_path / name / "mine.py" for name in "ab"]
    for path in paths:
        path.parent.mkdir()
        path.write_text(WEAR)
    plan, again = (Plan(operation=f"{path}:Wear") for path in paths)
    assert plan.key("vertical") == plan.key("axial")
    key = json.loads(plan.key("vertical"))
    assert (key["operation"], key["options"]) == (f"{paths[0]}:Wear", {"offset": 0.5})
    assert plan.key("vertical") == Plan(operation=plan.operation, operation_options={"offset": 0.5}).key(
        "vertical"
    )
    assert plan.key("vertical") != Plan(operation=plan.operation, operation_options={"offset": 1.0}).key(
        "vertical"
    )
    code = key["code"]
    assert json.loads(again.key("vertical"))["code"] == code
    paths[1].write_text(WEAR.replace("0.5", "0.6"))
    assert json.loads(again.key("vertical"))["code"] != code
    assert pickle.loads(pickle.dumps(plan)) == plan
