"""The demo: the paper's experiments on each sensor, here with few pixels and frames."""

from __future__ import annotations

import dataclasses
import json

import cv2
import numpy as np
import pytest
from commands import run, small_experiments, small_rotations

from mirrorskin import io, view
from mirrorskin.cli.demo import force, pose, presses, rotation, slip, vibration
from mirrorskin.view import canvas

FULL, ROTATIONS = presses.EXPERIMENTS, rotation.EXPERIMENTS
WAYS = "paper", "exact", "paper, registered", "exact, registered"
PAPERS, SENSORS = "conform-ideal", ["conform-ideal", "conform-cylinder", "elastic-ideal", "elastic-cylinder"]
LIGHTS = "ideal light", "lit wall"
TITLES = dict(
    zip(SENSORS, (f"{c}, {e}" for c in ("ideal contact", "elastic body") for e in LIGHTS), strict=True)
)
MADE = {"fig5": SENSORS, "fig6": SENSORS[:2], "fig6-soft": SENSORS}

DRAWN = *MADE, "fig10a", "fig10b", "fused", "force", "vibration", "slip", "pose"
SHAKEN = vibration.Experiment(strokes=4, size=60)
SLIPPED = slip.Experiment(frames=10, size=80)
FOLLOWED = pose.Experiment(touches=4, size=60)
FORCES = force.Experiment(scale=(), found=(force.Press(6, 0.6),), size=48)

# The table's rows.
EXPECTED = [
    [name, TITLES[sensor], method]
    for name, each in MADE.items()
    for sensor in each
    for method in (("eq. 4", "sub-frame") if sensor == PAPERS else ("sub-frame",))
]


@pytest.fixture(scope="module")
def shown(tmp_path_factory):
    """What a small demo printed, the folder that it made, and what its figures were drawn of."""
    folder = tmp_path_factory.mktemp("demo") / "made"
    figures, draw, turned, shaped = {}, view.height_figure, view.normal_figure, view.surface_figure

    def watch(results, truth, title, path, **style):
        figures[path.name] = (list(results), title, style)
        draw(results, truth, title, path, **style)

    def watch_normals(results, truth, title, path):
        figures[path.name] = (list(results), title)
        turned(results, truth, title, path)

    def watch_surfaces(results, truth, title, path):
        figures[path.name] = (list(results), title)
        shaped(results, truth, title, path)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(presses, "EXPERIMENTS", small_experiments())
        patch.setattr(rotation, "EXPERIMENTS", small_rotations())
        patch.setattr(force, "EXPERIMENT", FORCES)
        patch.setattr(vibration, "EXPERIMENT", SHAKEN)
        patch.setattr(slip, "EXPERIMENT", SLIPPED)
        patch.setattr(pose, "EXPERIMENT", FOLLOWED)
        patch.setattr(canvas, "_DPI", 40)  # nobody reads them here
        patch.setattr(view, "height_figure", watch)
        patch.setattr(view, "normal_figure", watch_normals)
        patch.setattr(view, "surface_figure", watch_surfaces)
        ended = run("demo", "-o", folder)
    assert ended.code == 0
    steps = ended.said.splitlines()
    assert [step.split(":")[0] for step in steps] == [
        f"{n} of {len(steps)}" for n in range(1, len(steps) + 1)
    ]
    return ended.out.splitlines(), folder, figures


def test_each_sensor_s_recording_and_result_and_each_figure_are_kept(shown):
    _, folder, _ = shown
    files = {f"{name}-{sensor}{end}" for name, each in MADE.items() for sensor in each for end in
             (".h5", "-result.h5")}  # fmt: skip
    files |= {"fig10a.h5"} | {f"fig10a-{way.replace(', ', '-')}-result.h5" for way in WAYS}
    files |= {f"vibration-{one}-result.h5" for one in ("strokes", "rocked", "dither")}
    files |= {"pose-first-result.h5", "pose-last-result.h5"}
    files |= {"force-cal.h5", "force-0-result.h5", "fused-result.h5"} | {f"{name}.png" for name in DRAWN}
    assert {path.name for path in folder.iterdir()} == files
    for name in DRAWN:
        assert cv2.imread(str(folder / f"{name}.png")).shape[0] > 100


def test_the_table_of_normals_tells_of_both_methods_before_and_after_registration(shown):
    start = next(number for number, line in enumerate(shown[0]) if "lost and flagged" in line)
    head, rows = cells(shown[0][start]), [cells(line) for line in shown[0][start + 1 : start + 5]]
    assert [row[:2] for row in rows] == [["fig10a", way] for way in WAYS]
    found = {
        row[1]: dict(zip(head[2:7], (float(one.split()[0]) for one in row[2:7]), strict=True)) for row in rows
    }
    assert [row[7:] == ["-", "-"] for row in rows] == ["registered" in way for way in WAYS]
    for told in found.values():
        assert 20 < told["answered"] <= 100
        assert 0 < told["median"] <= told["RMS"] <= told["99 %"] < 120
    for method in ("paper", "exact"):
        assert found[f"{method}, registered"]["median"] < found[method]["median"]
    legend = " ".join(shown[0][start + 5 : shown[0].index("", start)])
    for word in ("answered", "chi2", "registered"):
        assert f"{word}: " in legend


def test_the_table_tells_of_each_sensor_and_what_it_costs(shown):
    head, *rows = shown[0][: 1 + len(EXPECTED)]
    names = ["answered", "untouched", "RMS", "mean", "99 %", "shared", "cost"]
    assert cells(head) == ["experiment", "contact, light", "method", *names]
    assert [cells(row)[:3] for row in rows] == EXPECTED
    found = {}
    for row in rows:
        name, sensor, method, *told = cells(row)
        found[name, sensor, method] = dict(zip(names, (float(one.split()[0]) for one in told), strict=True))
    for (name, sensor, _), told in found.items():
        ideal = found[name, "ideal contact, ideal light", "sub-frame"]["shared"]
        assert told["answered"] > 50
        assert abs(told["mean"]) <= told["RMS"] < 2
        assert told["99 %"] > 0
        assert told["cost"] == pytest.approx(told["shared"] - ideal, abs=0.0011)
        # A sheet that only takes the object's shape is light where it touches; an elastic one before, too.
        share = told["untouched"] / told["answered"]
        assert share < 0.02 if sensor.startswith("ideal contact") else share > 0.05
    assert max(map(len, rows)) <= 110
    legend, last = shown[0][1 + len(EXPECTED) : shown[0].index("")], shown[0][-1]
    for word in names[:2] + names[5:]:
        assert f"{word}: " in " ".join(legend)
    assert last.endswith("fig5.png")


def test_the_table_of_surfaces_tells_what_was_measured_apart_from_what_was_filled(shown):
    _, folder, _ = shown
    start = next(number for number, line in enumerate(shown[0]) if "heights from" in line)
    names = ["answered", "median", "RMS", "99 %", "filled", "RMS there", "apex"]
    assert cells(shown[0][start]) == ["experiment", "heights from", *names]
    rows = [cells(line) for line in shown[0][start + 1 : start + 5]]
    ways = [["fig10b", "rotation"], ["fig10b", "rotation, registered"], ["fused", "press"]]
    assert [row[:2] for row in rows] == [*ways, ["fused", "press and rotation"]]
    found = {tuple(row[:2]): dict(zip(names, row[2:], strict=True)) for row in rows}
    for way in ways[:2]:
        # The whole lies at the truth's level, and the dark top has no answer.
        assert (found[*way]["apex"], found[*way]["RMS there"]) == ("-", "-")
        assert 0 < float(found[*way]["median"]) <= float(found[*way]["RMS"]) < 100
    fused = {name: float(told.split()[0]) for name, told in found["fused", "press and rotation"].items()}
    result = io.open_result(folder / "fused-result.h5")
    assert fused["answered"] + fused["filled"] <= np.count_nonzero(np.isfinite(result.height))
    assert fused["filled"] == np.count_nonzero(result.filled) > 0
    assert fused["median"] < float(found["fused", "press"]["median"])
    assert fused["RMS"] < float(found["fused", "press"]["RMS"])
    assert abs(fused["apex"]) < 100
    legend = " ".join(shown[0][start + 5 : -1])
    for word in ("answered", "filled", "apex", "registered"):
        assert f"{word}: " in legend


def test_the_table_of_forces_tells_found_and_true_newtons(shown):
    start = next(number for number, line in enumerate(shown[0]) if "error / sigma" in line)
    head, row = cells(shown[0][start]), cells(shown[0][start + 1])
    told = dict(zip(head, row, strict=True))
    assert (told["press"], told["depth"]) == ("ball 6 mm", "0.6 mm")
    assert abs(float(told["error"].split()[0])) < 5
    assert float(told["force"]) == pytest.approx(float(told["truth"]), rel=0.05)
    assert "truth: the twin's" in " ".join(shown[0][start + 2 : -1])


def test_the_table_of_slip_tells_what_was_found_beside_the_closed_forms(shown):
    start = next(number for number, line in enumerate(shown[0]) if "closed form" in line)
    head, *rows = (cells(line) for line in shown[0][start : start + 8])
    told = {row[0]: dict(zip(head, row, strict=True)) for row in rows}
    for way, tolerance in (("slide", 0.12), ("twist", 0.05)):
        stuck = {name: float(one) for name, one in told[f"{way}, stick radius"].items() if one[0].isdigit()}
        assert stuck["truth"] == pytest.approx(stuck["closed form"], abs=0.02)
        assert stuck["found"] == pytest.approx(stuck["truth"], abs=tolerance)
        assert float(told[f"{way}, displacement"]["found"]) < 8
    assert float(told["twist, angle"]["found"]) == pytest.approx(
        float(told["twist, angle"]["truth"]), rel=0.02
    )
    assert "stick radius: at the end" in " ".join(shown[0][start + 8 : -1])


def test_the_table_of_motion_tells_where_the_object_was_found(shown):
    start = next(number for number, line in enumerate(shown[0]) if line.startswith("motion "))
    head, *rows = (cells(line) for line in shown[0][start : start + 7])
    told = {row[0]: dict(zip(head[1:], map(float, row[1:]), strict=True)) for row in rows}
    for axis in "xyz":
        shift, turn = told[axis], told[f"turn about {axis}"]
        assert shift["found"] == pytest.approx(shift["truth"], abs=0.015)  # a fifth of a pixel
        assert turn["found"] == pytest.approx(turn["truth"], abs=0.25)
        assert 0 < shift["sigma"] < 0.01
        assert 0 < turn["sigma"] < 0.2
    assert told["turn about z"]["truth"] == 40
    assert "RMS on the way: " in " ".join(shown[0][start + 7 : -1])


def cells(row):
    return [cell.strip() for cell in row.split("  ") if cell.strip()]


@pytest.mark.slow
def test_json_tells_the_scores(tmp_path, monkeypatch):
    sphere, only = (dataclasses.replace(one, sensors=presses.SENSORS[:1]) for one in small_experiments()[:2])
    monkeypatch.setattr(presses, "EXPERIMENTS", (sphere, only))
    monkeypatch.setattr(rotation, "EXPERIMENTS", small_rotations())
    monkeypatch.setattr(force, "EXPERIMENT", FORCES)
    monkeypatch.setattr(vibration, "EXPERIMENT", SHAKEN)
    monkeypatch.setattr(slip, "EXPERIMENT", SLIPPED)
    monkeypatch.setattr(pose, "EXPERIMENT", FOLLOWED)
    for figure in ("force", "height", "normal", "pose", "slip", "surface", "vibration"):
        monkeypatch.setattr(view, f"{figure}_figure", lambda *given, **style: None)
    ended = run("demo", "-o", tmp_path, "--json")
    told = json.loads(ended.out)
    assert {name: list(scores) for name, scores in told["fig6"].items()} == {
        "conform, ideal": ["eq. 4", "sub-frame"]
    }
    ours, papers = (told["fig6"]["conform, ideal"][method] for method in ("sub-frame", "eq. 4"))
    assert ours["answered"] == papers["answered"] > 50
    assert ours["rms"] < papers["rms"]
    assert ours["shared_rms"] == pytest.approx(ours["rms"])  # one sensor shares all it answers
    assert papers["mean"] < -0.3 * only.step
    assert list(told["fig10a"]) == list(WAYS)
    assert told["fig10a"]["exact"]["normal"]["rms"] > 0
    rms = {way: shape["measured"]["rms"] for way, shape in told["fused"].items()}
    assert 0 < rms["press and rotation"] < rms["press"]


def test_vibrations_are_found_as_well_as_predicted(tmp_path):
    found = vibration.run(SHAKEN, tmp_path, None)
    assert found["height"]["found"] < 25
    assert abs(found["hysteresis"]["found"] - found["hysteresis"]["truth"]) < 8
    assert 0.7 < found["slope"]["chi2"] < 1.3
    assert found["height"]["sigma"] == pytest.approx(found["height"]["found"], rel=0.5)
    assert found["growth"]["found"] == pytest.approx(found["growth"]["truth"], rel=0.02)


def test_a_folder_that_cannot_be_made_is_one_line(tmp_path):
    (tmp_path / "file").touch()
    code, out, said = run("demo", "-o", tmp_path / "file" / "demo")
    assert (code, out, said.count("\n")) == (2, "", 1)
    assert "cannot be made" in said
    assert "choose another folder with -o" in said


def test_without_matplotlib_nothing_is_computed(tmp_path, monkeypatch):
    monkeypatch.setattr("mirrorskin.view.canvas.find_spec", lambda name: None)
    code, _, said = run("demo", "-o", tmp_path / "demo")
    assert (code, said.count("\n")) == (2, 1)
    assert "pip install 'mirrorskin" in said
    assert not (tmp_path / "demo").exists()
