"""The parts of ``make gpu-check`` and ``make gpu`` that need neither a compiler nor a GPU."""

import numpy as np
import pytest

from mirrorskin.evaluation.portability import gpu, gpu_check

PTXAS = """ptxas info    : 0 bytes gmem
ptxas info    : Compiling entry function 'scan' for 'sm_90'
ptxas info    : Function properties for scan
    16 bytes stack frame, 4 bytes spill stores, 8 bytes spill loads
ptxas info    : Used 65 registers, used 0 barriers, 16 bytes cumulative stack size
ptxas info    : Compiling entry function 'sum' for 'sm_90'
ptxas info    : Function properties for sum
    0 bytes stack frame, 0 bytes spill stores, 0 bytes spill loads
ptxas info    : Used 20 registers, used 0 barriers
"""

PTX = """
.entry scan(
\t.param .u64 scan_param_0
)
{
\tld.global.u8 \t%rs1, [%rd1];
\tcvt.f64.f32 \t%fd1, %f1;
}
.entry sum(
\t.param .u64 sum_param_0
)
{
\tld.global.nc.u32 \t%r1, [%rd1];
\tld.shared.u8 \t%rs1, [%rd1];
}
"""

ASSEMBLY = """
scan:                                   ; @scan
; TotalNumVgprs: 70
; ScratchSize: 24
; Occupancy: 7
sum:                                    ; @sum
; Occupancy: 8
    .name:           scan
    .private_segment_fixed_size: 24
    .sgpr_count:     16
    .sgpr_spill_count: 0
    .vgpr_count:     70
    .vgpr_spill_count: 3
  - .agpr_count:     0
    .name:           sum
    .private_segment_fixed_size: 0
    .reqd_workgroup_size:
      - 64
      - 1
      - 1
    .vgpr_count:     9
    .vgpr_spill_count: 0
"""

ROW = {
    "kernel": "sum",
    "options": "-DA=1",
    "registers": 60,
    "stack": 0,
    "spills": 0,
    "doubles": 0,
    "byte loads": 0,
    "AMD registers": 40,
    "AMD scratch": 0,
    "AMD spills": 0,
}


def test_report_of_ptxas_is_read_by_kernel():
    scan, total = gpu_check.read_ptxas(PTXAS, PTX).values()
    assert scan == {"registers": 65, "stack": 16, "spills": 12, "warps": 28, "doubles": 1, "byte loads": 1}
    assert total == {"registers": 20, "stack": 0, "spills": 0, "warps": 64, "doubles": 0, "byte loads": 0}


def test_assembly_for_amd_is_read_by_kernel():
    assert gpu_check.read_assembly(ASSEMBLY) == {
        "scan": {"AMD registers": 70, "AMD scratch": 24, "AMD spills": 3, "AMD waves": 7},
        "sum": {"AMD registers": 9, "AMD scratch": 0, "AMD spills": 0, "AMD waves": 8},
    }


def test_the_most_of_all_options_is_kept():
    rows = [{**ROW, "registers": 70, "options": "-DA=2"}, {**ROW, "stack": 8}]
    assert gpu_check.worst(rows) == {"sum": {**ROW, "registers": 70, "stack": 8, "options": "-DA=2"}}


@pytest.mark.parametrize(
    ("changed", "complaints"),
    [
        ({}, []),
        ({"registers": 70}, []),
        ({"registers": 96}, ["sum: 96 registers where it took 60, with -DA=1"]),
        ({"doubles": 2}, ["sum: 2 doubles, with -DA=1"]),
        ({"AMD spills": 5}, ["sum: 5 AMD spills, with -DA=1"]),
    ],
)
def test_kernels_with_more_registers_or_spills_are_printed(changed, complaints):
    assert list(gpu_check.complaints({**ROW, **changed}, ROW)) == complaints


def test_without_tools_the_remedy_is_one_line(monkeypatch, capsys):
    monkeypatch.setattr(gpu_check.shutil, "which", lambda *_, **__: None)
    monkeypatch.setattr("sys.argv", ["gpu_check.py"])
    assert gpu_check.main() == 2
    message = (
        "make gpu-check: install a clang and its libclc first (Debian: apt install clang-19 libclc-19)\n"
    )
    assert capsys.readouterr().err == message


def test_answers_differ_only_where_they_mean_something():
    contact = np.zeros((40, 50), np.uint8)
    contact[10:] = 1
    frozen = {"a.contact": contact, "a.normals": np.zeros((40, 50, 3), np.float32)}
    answers = {**frozen, "a.normals": frozen["a.normals"].copy()}
    answers["a.normals"][:10] = 1
    assert not gpu.differs(answers, frozen, "a.normals", (0, 1e-3))
    answers["a.normals"][20] = 1
    assert "150 of 4500" in gpu.differs(answers, frozen, "a.normals", (0, 1e-3))
