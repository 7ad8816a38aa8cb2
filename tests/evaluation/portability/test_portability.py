"""The parts of ``make portability`` that need no other implementation of OpenCL."""

import os
import subprocess
from pathlib import Path

import pytest

from mirrorskin.evaluation.portability import faults, portability
from mirrorskin.evaluation.portability.portability import Check, Finding

REPORT = """
Invalid write of size 4 at global memory address 0x2000000000040
\tKernel: fault
\tEntity: Global(15,0,0) Local(0,0,0) Group(15,0,0)
\t  store float %conv1, float addrspace(1)* %arrayidx, align 4
\tAt line 1 (column 83) of input.cl:
\t  kernel void fault(global float *x, const int n) { }

"""

XML = """<?xml version="1.0" encoding="utf-8"?>
<testsuites name="pytest tests"><testsuite name="pytest" errors="1" failures="2" skipped="3" tests="40">
<testcase name="test_a"/></testsuite></testsuites>
"""


@pytest.fixture
def library(tmp_path):
    file = tmp_path / "libother.so"
    file.touch()
    return file


@pytest.fixture
def other(library):
    """A check that can be made, and watches for all faults."""
    pattern = str(library.relative_to("/"))
    return Check("other", "package", pattern, faults=tuple(faults.FAULTS), variables={"OTHER": "1"})


@pytest.fixture
def kernels(monkeypatch):
    """Kernels that end with a status and leave a report, by the name of their fault; without one: sound."""
    reports = {name: (0, f"{words} of some kind\n") for name, (_, words) in faults.FAULTS.items()}
    reports[None] = (0, "")

    def run(environment, fault=None):
        status, report = reports[fault]
        if report:
            Path(environment["OCLGRIND_LOG"]).write_text(report)
        return subprocess.CompletedProcess([], status, "1.0\n", "no such luck")

    monkeypatch.setattr(portability, "run_kernel", run)
    return reports


@pytest.fixture
def passing(monkeypatch):
    monkeypatch.setattr(portability, "run_tests", lambda *_: ("5 of 5", ()))


@pytest.fixture(autouse=True)
def no_other_root(monkeypatch, tmp_path):
    monkeypatch.setattr(portability, "TESTING", tmp_path / "none")


def test_missing_ones_are_reported_in_one_line_after_the_others_ran(monkeypatch, capsys, other):
    absent = [Check("absent", f"install {name}", "/no/such/file") for name in ("two", "one", "two")]
    monkeypatch.setattr(portability, "CHECKS", (*absent, other))
    monkeypatch.setattr(portability, "examine", lambda *_: Finding("1.0", "5 of 5", "0"))
    assert portability.main([]) == 2
    out, err = capsys.readouterr()
    assert len(out.splitlines()) == 3
    assert err == "make portability: not all are here: install one; install two\n"


@pytest.mark.parametrize(("details", "status"), [((), 0), (("this is wrong",), 1)])
def test_table_has_a_row_for_each_check_and_status_is_1_after_an_error(
    monkeypatch, capsys, other, details, status
):
    monkeypatch.setattr(portability, "CHECKS", (other, Check("unasked", "", "/no/such/file")))
    monkeypatch.setattr(portability, "examine", lambda *_: Finding("1.0", "4 of 5", "7", details))
    assert portability.main(["other"]) == status
    out, err = capsys.readouterr()
    rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in out.splitlines()]
    assert rows == [
        ["implementation", "version", "device tests passed", "reports", "min"],
        ["---"] * 5,
        ["other", "1.0", "4 of 5", "7", "0.0"],
    ]
    assert err.splitlines() == list(details)


def test_a_child_sees_one_implementation_and_none_of_the_users_choices(monkeypatch, tmp_path, other, library):
    monkeypatch.setenv("PYOPENCL_CTX", "1")
    monkeypatch.setenv("POCL_CACHE_DIR", "/somewhere")
    environment = portability.environment_for(other, tmp_path)
    changed = dict(environment.items() - os.environ.items())
    assert not {"PYOPENCL_CTX", "POCL_CACHE_DIR"} & environment.keys()
    assert changed == {
        "OCL_ICD_VENDORS": str(library),
        "OCLGRIND_LOG": str(tmp_path / "reports"),
        "XDG_CACHE_HOME": str(tmp_path / "cache"),
        "OTHER": "1",
    }


@pytest.mark.usefixtures("kernels", "passing")
def test_all_is_well_where_faults_are_reported_and_tests_pass(other):
    assert portability.examine(other) == Finding("1.0", "5 of 5", "0")


@pytest.mark.usefixtures("passing")
def test_an_implementation_that_lets_a_fault_pass_is_not_believed(kernels, other):
    kernels["two writers"] = 0, ""
    kernels["a value never set"] = 0, REPORT
    finding = portability.examine(other)
    assert finding.details == ("not reported: two writers, a value never set",)
    assert finding.tests == "-"


@pytest.mark.usefixtures("passing")
@pytest.mark.parametrize(("report", "detail"), [((1, ""), "no such luck"), ((0, REPORT), REPORT)])
def test_an_implementation_that_fails_a_sound_kernel_is_not_believed(kernels, other, report, detail):
    kernels[None] = report
    finding = portability.examine(other)
    assert finding.tests == "-"
    assert detail in finding.details


@pytest.mark.usefixtures("kernels")
def test_a_report_is_a_failure_even_where_all_tests_pass(monkeypatch, other):
    def run(which, environment, *_):
        Path(environment["OCLGRIND_LOG"]).write_text(REPORT * 3)
        return "5 of 5", ()

    monkeypatch.setattr(portability, "run_tests", run)
    assert portability.examine(other) == Finding("1.0", "5 of 5", "3", (REPORT * 3,))


def asking(tests):
    """A check that is given these of the tests in the project's top folder."""
    return Check("other", "package", "no/such/file", tests=tests, folders=(".",))


def write_test(folder, body):
    """Make a project of one test and return the environment to run it in."""
    (folder / "pytest.ini").write_text("[pytest]\nmarkers =\n    device\n")
    (folder / "test_it.py").write_text(
        f"import os, pytest\n\n@pytest.mark.device\ndef test_it():\n    {body}\n"
    )
    return dict(os.environ)


@pytest.mark.parametrize(
    ("body", "shown", "word"),
    [
        ("pass", "1 of 1", ""),
        ("assert 2 < 1", "0 of 1", "assert 2 < 1"),
        ("pytest.skip('not here')", "0 of 1", "1 skipped"),
        ("os._exit(9)", "ended with 9", ""),
    ],
)
def test_output_of_pytest_is_shown_unless_all_pass(monkeypatch, tmp_path, body, shown, word):
    monkeypatch.setattr(portability, "ROOT", tmp_path)
    environment = write_test(tmp_path, body)
    tests, details = portability.run_tests(asking(""), environment, tmp_path / "tests.xml")
    assert tests == shown
    assert bool(details) == (shown != "1 of 1")
    assert word in "".join(details)


def test_no_tests_at_all_is_a_failure(monkeypatch, tmp_path):
    monkeypatch.setattr(portability, "ROOT", tmp_path)
    tests, details = portability.run_tests(asking(""), dict(os.environ), tmp_path / "tests.xml")
    assert (tests, bool(details)) == ("0 of 0", True)


def test_only_the_tests_asked_for_are_run(monkeypatch, tmp_path):
    monkeypatch.setattr(portability, "ROOT", tmp_path)
    environment = write_test(tmp_path, "pass")
    with (tmp_path / "test_it.py").open("a") as file:
        file.write("\ndef test_without_a_device(): assert False\n")
        file.write("\n@pytest.mark.device\ndef test_statistics(): assert False\n")
    tests, details = portability.run_tests(asking("not statistics"), environment, tmp_path / "tests.xml")
    assert (tests, details) == ("1 of 1", ())


def test_only_what_passed_counts_as_passed(tmp_path):
    record = tmp_path / "tests.xml"
    record.write_text(XML)
    assert portability.count_tests(record) == (40, 34)


def test_a_report_is_counted_once(tmp_path):
    log = tmp_path / "reports"
    assert portability.reports_in(log) == []
    log.write_text(REPORT + REPORT.replace("Invalid write", "Invalid read"))
    assert [line.split(" of ")[0] for line in portability.reports_in(log)] == [
        "Invalid write",
        "Invalid read",
    ]


@pytest.mark.parametrize("name", faults.FAULTS)
def test_each_fault_compiles(device, name):
    assert faults.build(device.context, faults.FAULTS[name][0]).function_name == "fault"
